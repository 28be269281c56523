"""Whether systemd runs the daemon of a configuration, where there is a systemd."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from resonator_daemon.doctor.finding import Area, Check, Finding
from resonator_daemon.doctor.host import Host

UNIT: Final = Check("service.unit", Area.SOFTWARE, "systemd unit")
RULES: Final = Check("service.rules", Area.SOFTWARE, "udev rules")

_UNIT: Final = "resonatord@.service"
_UNIT_PLACES: Final = ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")
_RULE_PLACES: Final = ("/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
_CONFIGURATIONS: Final = Path("/etc/resonatord")


def check_service(config_path: Path | None, host: Host) -> Iterator[Finding]:
    """Yield whether unit and rules are installed; a configuration that is run by hand needs neither."""
    if not host.at("/run/systemd/system").is_dir():
        yield UNIT.not_checked("no systemd runs here")
        return
    if config_path is None or config_path.absolute().parent != _CONFIGURATIONS:
        yield UNIT.not_checked(f"the configuration is not in {_CONFIGURATIONS}: it is run by hand")
        return
    unit = next((place for place in _UNIT_PLACES if host.at(f"{place}/{_UNIT}").exists()), None)
    if unit is None:
        yield UNIT.warning(f"{_UNIT} is not installed: nothing starts the daemon", "sudo resonatord install")
        return
    yield UNIT.ok(f"{unit}/{_UNIT}")
    rules = [file for place in _RULE_PLACES for file in host.at(place).glob("*resonator*.rules")]
    if rules:
        yield RULES.ok(", ".join(file.name for file in rules))
    else:
        yield RULES.warning("none is installed: the board starts no daemon", "sudo resonatord install")
