"""Prints each contact event of a plate once and in order, also those that were missed: events.py HOST PORT NAME."""

import asyncio
import sys

import resonatord

if len(sys.argv) != 4:
    sys.exit(__doc__)
host, port, name = sys.argv[1:]
url = f"mqtt://{host}:{port}"


class Follower:
    """The last event that was printed, by run of the daemon and number; and the way to what follows it."""

    def __init__(self):
        self.boot_id, self.seq = None, -1

    async def follow(self):
        topics = ["contacts/event", "state/daemon"]  # each connection begins with the state, which is retained
        async for _, path, message in resonatord.subscribe(url, name, topics):
            try:
                if path == "state/daemon" or message.daemon_boot_id != self.boot_id or message.seq > self.seq + 1:
                    await self.catch_up()
                elif message.seq == self.seq + 1:  # else it came before
                    self.print(message)
            except (resonatord.BrokerUnreachableError, resonatord.NoDaemonError, resonatord.NoAnswerError) as error:
                print(f"later again: {error}", file=sys.stderr)

    async def catch_up(self):
        if self.boot_id is None:
            self.boot_id = (await self.ask(None)).daemon_boot_id
        while (next_id := await self.print_rest_of(self.boot_id)) is not None:  # the daemon was started again
            self.boot_id, self.seq = next_id, -1

    async def print_rest_of(self, boot_id):
        """Print the events of a run after the last printed one, and return the next run."""
        more = True
        while more:
            try:
                answer = await self.ask(boot_id)
            except resonatord.RefusedError as error:
                print(f"events of run {boot_id} after {self.seq} are missing: {error.code}", file=sys.stderr)
                present = (await self.ask(None)).daemon_boot_id
                return present if present != boot_id else None
            if not answer.complete:
                print(f"events of run {boot_id} after {self.seq} are missing", file=sys.stderr)
            for event in answer.events:
                self.print(event)
            more = answer.events and self.seq < answer.newest_seq
        return answer.next_daemon_boot_id

    async def ask(self, boot_id):
        return await resonatord.command(url, name, "events", after_seq=self.seq, daemon_boot_id=boot_id)

    def print(self, event):
        self.seq = event.seq
        print(
            f"{event.daemon_boot_id} {event.seq} t_ns {event.t_ns} {event.event} contact {event.contact.id}", flush=True
        )


try:
    asyncio.run(Follower().follow())
except resonatord.UserError as error:
    sys.exit(str(error))
except KeyboardInterrupt:
    pass
