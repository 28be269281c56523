"""Prints each contact event of a plate once and in order, also those that it missed while it was not connected."""

import argparse
import asyncio
import contextlib
import json
import secrets
import sys
from collections import deque

import aiomqtt

ANSWER_S = 10
AGAIN_S = 1

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("name", help="of the plate")
parser.add_argument("--host", default="127.0.0.1")
parser.add_argument("--port", type=int, default=1883)
parser.add_argument("--prefix", default="resonator")
options = parser.parse_args()
base = f"{options.prefix}/{options.name}"


class Follower:
    """The last event that was printed, by run of the daemon and number; and the way to what follows it."""

    def __init__(self):
        self.boot_id, self.seq = None, -1

    async def follow(self, client):
        self.client, self.waiting = client, deque()
        await client.subscribe([(f"{base}/contacts/event", 1), (f"{base}/rsp/events", 1)])
        await self.catch_up()
        while True:
            message = self.waiting.popleft() if self.waiting else await anext(client.messages)
            event = json.loads(message.payload)
            if message.topic.value != f"{base}/contacts/event":
                continue  # an answer to another client
            if event["daemon_boot_id"] != self.boot_id or event["seq"] > self.seq + 1:
                await self.catch_up()
            elif event["seq"] == self.seq + 1:  # else it came before
                self.print(event)

    async def catch_up(self):
        present = await self.ask(None)
        if self.boot_id not in (None, present["daemon_boot_id"]):  # the daemon was started again
            await self.print_rest_of(self.boot_id)
            self.seq = -1
        self.boot_id = present["daemon_boot_id"]
        await self.print_rest_of(self.boot_id)

    async def print_rest_of(self, boot_id):
        more = True
        while more:
            answer = await self.ask(boot_id)
            if not answer["ok"] or not answer["complete"]:
                print(f"events of run {boot_id} after {self.seq} are missing", file=sys.stderr)
            for event in answer.get("events", []):
                self.print(event)
            more = answer.get("events") and self.seq < answer["newest_seq"]

    async def ask(self, boot_id):
        """Return the daemon's answer; events that come meanwhile wait."""
        request = {"id": secrets.token_hex(8), "after_seq": self.seq, "daemon_boot_id": boot_id}
        await self.client.publish(f"{base}/cmd/events", json.dumps(request), qos=1)
        async with asyncio.timeout(ANSWER_S):
            while True:
                message = await anext(self.client.messages)
                answer = json.loads(message.payload)
                if message.topic.value == f"{base}/rsp/events" and answer["id"] == request["id"]:
                    break
                self.waiting.append(message)
        if not answer["ok"] and boot_id is None:
            sys.exit(f"{answer['error']['code']}: {answer['error']['message']}")
        return answer

    def print(self, event):
        self.seq = event["seq"]
        contact = event["contact"]
        print(
            f"{event['daemon_boot_id']} {self.seq} t_ns {event['t_ns']} {event['event']} contact {contact['id']}",
            flush=True,
        )


async def main():
    follower = Follower()
    while True:
        try:
            async with aiomqtt.Client(options.host, options.port) as client:
                await follower.follow(client)
        except (aiomqtt.MqttError, TimeoutError) as error:  # no broker, or no daemon that answers
            print(f"trying again: {error or 'no answer'}", file=sys.stderr)
            await asyncio.sleep(AGAIN_S)


with contextlib.suppress(KeyboardInterrupt):
    asyncio.run(main())
