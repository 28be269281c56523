"""What the whole system costs and how fast it is: the demo without a screen, its latency and each part's share.

Run it with `python benchmarks/demo_cost.py [SECONDS]`.
"""

import json
import subprocess
import sys


def main() -> int:
    seconds = sys.argv[1] if len(sys.argv) > 1 else "20"
    command = [sys.executable, "-m", "resonator_daemon", "demo", "--headless", "--seconds", seconds, "--json"]
    run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if not run.stdout:
        return run.returncode
    result = json.loads(run.stdout)
    print(f"{'part':30} {'% of a core':>12}")
    for part, percent in sorted(result["cpu_percent_by_part"].items(), key=lambda item: -item[1]):
        print(f"{part:30} {percent:12.1f}")
    print(f"{'all, against 2 cores':30} {100 * result['cores']:12.1f}   {result['cores'] / 2:.2f} of the machine\n")
    for name, plate in result["plates"].items():
        print(name)
        for key, value in plate.items():
            if value is not None:
                print(f"  {key:24} {value}")
    return run.returncode


if __name__ == "__main__":
    sys.exit(main())
