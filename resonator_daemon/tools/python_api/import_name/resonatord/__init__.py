"""Forces on a tactile plate of quartz, from a recording or as they are measured.

>>> import resonatord
>>> recording = resonatord.load_recording("run.mcap")
>>> recording.contacts.to_pandas()
>>> async for plate, path, message in resonatord.subscribe("mqtt://127.0.0.1:1883", "left-index"): ...
>>> await resonatord.command("mqtt://127.0.0.1:1883", "left-index", "tare")

Names are imported when they are used first, so that `import resonatord` needs no other library.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from resonator_daemon.base.errors import UserError
    from resonator_daemon.board.config.mqtt import Mqtt
    from resonator_daemon.mqtt.payloads import (
        ContactEvent,
        Contacts,
        Decoded,
        DecodedSummary,
        Forces,
        Health,
        Info,
        Signals,
        State,
    )
    from resonator_daemon.mqtt.requests import BrokerUnreachableError, NoAnswerError, NoDaemonError, RefusedError
    from resonator_daemon.mqtt.subscriber import Received
    from resonator_daemon.tools.python_api import RecordingError, RecordingWarning
    from resonator_daemon.tools.python_api.live import command, subscribe
    from resonator_daemon.tools.python_api.recordings import LoadedRecording, Mark, load_recording
    from resonator_daemon.tools.python_api.tables import Table

    __version__: str

__all__ = [
    "BrokerUnreachableError",
    "ContactEvent",
    "Contacts",
    "Decoded",
    "DecodedSummary",
    "Forces",
    "Health",
    "Info",
    "LoadedRecording",
    "Mark",
    "Mqtt",
    "NoAnswerError",
    "NoDaemonError",
    "Received",
    "RecordingError",
    "RecordingWarning",
    "RefusedError",
    "Signals",
    "State",
    "Table",
    "UserError",
    "__version__",
    "command",
    "load_recording",
    "subscribe",
]

_MODULES: Final = {
    "resonator_daemon.board.config": ("Mqtt",),
    "resonator_daemon.base.errors": ("UserError",),
    "resonator_daemon.mqtt.payloads": (
        *("ContactEvent", "Contacts", "Decoded", "DecodedSummary", "Forces", "Health", "Info", "Signals", "State"),
    ),
    "resonator_daemon.mqtt.requests": ("BrokerUnreachableError", "NoAnswerError", "NoDaemonError", "RefusedError"),
    "resonator_daemon.mqtt.subscriber": ("Received",),
    "resonator_daemon.tools.python_api": ("RecordingError", "RecordingWarning"),
    "resonator_daemon.tools.python_api.live": ("command", "subscribe"),
    "resonator_daemon.tools.python_api.recordings": ("LoadedRecording", "Mark", "load_recording"),
    "resonator_daemon.tools.python_api.tables": ("Table",),
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("resonatord")
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module 'resonatord' has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__
