"""Prints the force on each touched site, and contact events: forces.py [HOST [PORT [NAME]]]."""

import asyncio
import sys

import resonatord

host, port, name = sys.argv[1:] + ["127.0.0.1", "1883", None][len(sys.argv) - 1 :]


async def main():
    topics = ["forces", "contacts/event"]
    async for plate, path, message in resonatord.subscribe(f"mqtt://{host}:{port}", name, topics):
        where = f"{plate}/{path} t_ns {message.t_ns}"
        if isinstance(message, resonatord.ContactEvent):
            print(f"{where} {message.event} contact {message.contact.id} site {message.contact.site}", flush=True)
            continue
        for site in message.sites:  # force_newton is nan where it is not known; the status says why
            print(f"{where} site {site.site} {site.force_newton} N {site.status}", flush=True)


try:
    asyncio.run(main())
except resonatord.UserError as error:
    sys.exit(str(error))
except KeyboardInterrupt:
    pass
