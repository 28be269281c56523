"""`python -m resonator_daemon.commands`: the command `resonatord`."""

import sys

from resonator_daemon.commands import main

sys.exit(main())
