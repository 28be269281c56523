"""What the viewers of several extensions show: shape of a plate, clouds of points, states as text; and MCAP files."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from resonator_daemon.base.plate import Plate
from resonator_daemon.board.recording.mcap_messages import CHUNK_BYTES
from resonator_daemon.mqtt.payload_types import AXES, with_axis
from resonator_daemon.mqtt.payloads import Condition, Contact, Decoded, Forces, Info, Message, Signals, State
from resonator_daemon.tools.export.output import Output

Places = NDArray[np.float64]
"""(n, 2): x and y in metres in the frame of the plate, whose z points into it."""


Points = NDArray[np.void]
"""Structured, (n,): x, y and z in metres as float32, and values named with their units; z points into the plate."""

_OF_FORCES: Final = ("force_newton", "noise_newton", "systematic_newton", "unobserved_bound_newton")
_OF_SIGNALS: Final = ("p_n", "eps_xz", "eps_yz")  # the rows of `signals`


@dataclass(frozen=True)
class Geometry:
    """Outline, transducers and sites of one plate; its messages as clouds of points.

    Parameters
    ----------
    outline_m, transducers_m
        Corners, and transducers in the order of the channels.
    site_ids
        Numbers of the sites.
    sites_m
        Places of the sites, in the same order.
    force_max_newton
        End of the plate's range.
    """

    outline_m: Places
    transducers_m: Places
    site_ids: tuple[int, ...]
    sites_m: Places
    force_max_newton: float

    @classmethod
    def of_plate(cls, plate: Plate) -> Self:
        ids = tuple(int(site) for site in plate.site_ids)
        return cls(plate.outline_m, plate.transducers_m, ids, plate.site_positions_m, plate.force_max_newton)

    @classmethod
    def of_info(cls, info: Info) -> Self:
        ids = tuple(site.site for site in info.sites)
        sites_m = np.array([site.position_m for site in info.sites]).reshape(-1, 2)
        outline_m, transducers_m = (np.array(each).reshape(-1, 2) for each in (info.outline_m, info.transducers_m))
        return cls(outline_m, transducers_m, ids, sites_m, info.force_max_newton)

    def fits(self, message: Message) -> bool:
        """Return whether a message is of these sites, and not of a plate that had the name before or has it now."""
        match message:
            case Forces():
                return all(force.site in self._row_of_site for force in message.sites)
            case Signals():
                return len(message.signals[0]) == len(self.sites_m)
            case Decoded():
                return on_grid(message) or len(message.traction_pascal[0]) == len(self.sites_m)
        return True

    def points(self, message: Message) -> Points | None:
        """Return the cloud of a message: of forces those sites on which something presses; None of kinds without."""
        match message:
            case Forces():
                return self._forces(message)
            case Signals():
                rows = {
                    f"{prefix}{name}{suffix}": values
                    for prefix, suffix, array in (("", "", message.signals), ("", "_std", message.noise_std))
                    for name, values in zip(_OF_SIGNALS, array, strict=True)
                }
                return _cloud(self.sites_m, rows)
            case Decoded():
                return self._decoded(message)
        return None

    def site_points(self) -> Points:
        """Return the cloud of all sites, each with its number."""
        return _cloud(self.sites_m, {"site": np.array(self.site_ids, "<u2")})

    @cached_property
    def _row_of_site(self) -> dict[int, int]:
        return {site: row for row, site in enumerate(self.site_ids)}

    def _forces(self, message: Forces) -> Points:
        rows = [self._row_of_site[force.site] for force in message.sites]
        values: dict[str, Any] = {"site": np.array([force.site for force in message.sites], "<u2")}
        for key in _OF_FORCES:
            values[key] = np.array([getattr(force, key) for force in message.sites], "<f8")
        return _cloud(self.sites_m[rows], values)

    def _decoded(self, message: Decoded) -> Points:
        values = map_values(message)
        if message.grid is None or not on_grid(message):  # a map of few sites has its values there
            return _cloud(self.sites_m, values)
        ny, nx = message.traction_pascal.shape[1:]
        (x, y), pitch = message.grid.origin_m, message.grid.pitch_m
        places = np.meshgrid(x + pitch * np.arange(nx), y + pitch * np.arange(ny))
        return _cloud(np.stack([place.ravel() for place in places], 1), values)


def on_grid(message: Decoded) -> bool:
    """Return whether a map has pixels; else its values are those of the sites."""
    return message.grid is not None and message.traction_pascal.ndim == 3


def map_values(message: Decoded) -> dict[str, NDArray[Any]]:
    """Return the components of a map's arrays by name, each (n,), row by row."""
    values: dict[str, NDArray[Any]] = {}
    for key in ("traction_pascal", "traction_std_pascal", "displacement_m"):
        array = getattr(message, key)
        if array is not None:
            values |= {with_axis(key, axis): part.ravel() for axis, part in zip(AXES, array, strict=True)}
    return values


def packed(values: Mapping[str, NDArray[Any]], count: int) -> Points:
    """Return values side by side, (count,), structured."""
    points: Points = np.zeros(count, [(name, array.dtype.str) for name, array in values.items()])
    for name, array in values.items():
        points[name] = array
    return points


def _cloud(positions_m: NDArray[np.float64], values: dict[str, NDArray[Any]]) -> Points:
    x, y = positions_m.T.astype("<f4")
    return packed({"x": x, "y": y, "z": np.zeros_like(x)} | values, len(positions_m))


def cloud_fields(points: Points, types: Mapping[str, int], type_key: str) -> list[dict[str, Any]]:
    """Return name, offset and type of each field of a cloud; `types` has the number of each numpy type."""
    return [
        {"name": name, "offset": field[1], type_key: types[field[0].str]}
        for name, field in (points.dtype.fields or {}).items()
    ]


def about_origin(contact: Contact) -> NDArray[np.float64]:
    """Return force and moment about the plate's origin, (2, 3); of a force site those of its normal force."""
    if contact.moment_newton_m is not None:
        return np.array([contact.force_newton, contact.moment_newton_m], float)
    (x, y), normal_newton = contact.position_m, contact.force_newton[2]
    return np.array([(0.0, 0.0, normal_newton), (y * normal_newton, -x * normal_newton, 0.0)])


OK, WARN, ERROR = range(3)  # as diagnostic_msgs/DiagnosticStatus counts


def severity(state: Condition) -> int:
    """Return how bad a state is: an error must be repaired, and a warning may pass."""
    match state:
        case Condition.ONLINE | Condition.STARTING:
            return OK
        case Condition.REFUSED:
            return ERROR
    return WARN


def state_text(message: State) -> str:
    """Return state and reason as one line."""
    return f"{message.state}: {message.reason}" if message.reason else str(message.state)


METADATA: Final = "resonatord"


class McapOutput(Output):
    """One MCAP file.

    Attributes
    ----------
    profile, schema_encoding, message_encoding : str
        As MCAP names them.
    channel_metadata : dict
        Metadata of each channel.
    prefix : str
        Left out of the names of channels in `rows`.
    """

    profile: ClassVar[str] = ""
    schema_encoding: ClassVar[str]
    message_encoding: ClassVar[str]
    channel_metadata: ClassVar[Mapping[str, str]] = {}
    prefix = ""

    def begin(self) -> None:
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._writer = Writer(self._new_file().file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(self.profile, METADATA)
        self._writer.add_metadata(METADATA, dict(self._recorded.metadata))

    def write(self, channel: str, schema: str, definition: str, data: bytes, log_ns: int, publish_ns: int) -> None:
        """Write one message; `definition` is the text of its schema, used the first time."""
        if channel not in self._channels:
            if schema not in self._schemas:
                self._schemas[schema] = self._writer.register_schema(schema, self.schema_encoding, definition.encode())
            self._channels[channel] = self._writer.register_channel(
                channel, self.message_encoding, self._schemas[schema], dict(self.channel_metadata)
            )
        self._writer.add_message(self._channels[channel], log_ns, data, publish_ns)
        self.rows[channel.removeprefix(self.prefix)] += 1

    def finish(self) -> None:
        self._writer.finish()
