"""A reader of the board program, with its arrivals by kind."""

from listener import Listener, check_bytes, check_indices

from resonator_daemon.board.session.frames import BoardOnline


class FirmwareListener(Listener):
    """Arrivals in order."""

    @property
    def boards(self) -> list[BoardOnline]:
        return [arrival for arrival in self.arrivals if isinstance(arrival, BoardOnline)]

    def wait_for_more_frames(self, more: int) -> None:
        self.wait_for_frames(len(self.frames) + more)

    def check_accounts(self) -> None:
        check_bytes(self.reader.counters())
        check_indices(self.arrivals)
