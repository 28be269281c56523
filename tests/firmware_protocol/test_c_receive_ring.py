"""The ring between a receiving interrupt and the main loop, with an interrupt at each place where order matters."""

import subprocess
from pathlib import Path

from c_reference import build

# Each barrier is where an interrupt may come between two steps of the other side; here one comes at every one of them.
PROGRAM = """
#include <stdio.h>
static void interrupt(void);
#define RECEIVE_RING_BARRIER() interrupt()
#include "common/receive_ring.h"

static struct receive_ring ring;
static uint32_t sent, barriers;
static int within;

static void interrupt(void)
{
    barriers++;
    if (within)
        return;
    within = 1;
    for (int more = 0; more < 3 && receive_ring_write(&ring, (uint8_t)sent, sent * 5u); more++)
        sent++;
    within = 0;
}

int main(void)
{
    uint8_t bytes[32];
    uint32_t counts = 0, seen = 0, rounds = 0;
    size_t count;
    ring.written = ring.read = 0xFFFFFF80u; /* the indices wrap */
    interrupt();
    while (rounds++ < 10000) {
        count = receive_ring_read(&ring, bytes, 1 + rounds % sizeof bytes, &counts);
        for (size_t i = 0; i < count; i++)
            if (bytes[i] != (uint8_t)seen++)
                return 1;
        if (count > 0 && counts != (seen - 1) * 5u)
            return 2;
    }
    within = 1; /* no more of them */
    while ((count = receive_ring_read(&ring, bytes, sizeof bytes, &counts)) > 0)
        seen += (uint32_t)count;
    printf("%d %d\\n", barriers > 2 * 10000, sent > 10000);
    return seen == sent ? 0 : 3;
}
"""


def test_no_byte_is_lost_or_read_before_it_is_there(tmp_path: Path) -> None:
    source = tmp_path / "ring.c"
    source.write_text(PROGRAM)
    done = subprocess.run([build(tmp_path / "ring", str(source))], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()) == (0, ["1", "1"])


def test_a_full_ring_refuses_a_byte(tmp_path: Path) -> None:
    source = tmp_path / "full.c"
    source.write_text(
        '#include "common/receive_ring.h"\nstatic struct receive_ring ring;\n'
        "int main(void)\n{\n    int fits = 0;\n    while (receive_ring_write(&ring, 1, 1))\n        fits++;\n"
        "    return fits == RECEIVE_RING_SLOTS ? 0 : 1;\n}\n"
    )
    assert subprocess.run([build(tmp_path / "full", str(source))], check=False).returncode == 0
