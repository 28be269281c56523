"""The options of `resonatord export`."""

import argparse
from pathlib import Path
from typing import Final

CSV, MCAP, NPZ, PARQUET, ROS2 = "csv", "mcap", "npz", "parquet", "ros2"
FORMATS: Final = (CSV, MCAP, NPZ, PARQUET, ROS2)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare everything that `export` takes."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording, as run.mcap")
    parser.add_argument(
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="new file, as out.npz; of .csv and .parquet one for each topic, as out-forces.csv for out.csv, or OUT "
        "itself where --topics has one",
    )
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--format", choices=FORMATS, help="default: by the ending of OUT")
    how.add_argument(
        "--ros2",
        dest="format",
        action="store_const",
        const=ROS2,
        help="MCAP with messages of ROS 2, ends in .mcap",
    )
    parser.add_argument("--topics", metavar="A,B", help="as forces,contacts/event (default: all that the format takes)")
    parser.add_argument("--config", type=Path, metavar="FILE", help="instead of the plate and settings it carries")
    parser.add_argument("--from", dest="start", metavar="MARK|SECONDS", help="leave out what was before")
    parser.add_argument("--until", dest="end", metavar="MARK|SECONDS", help="end there")
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end, and nothing else")
    parser.set_defaults(refuse=parser.error)
