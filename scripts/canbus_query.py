#!/usr/bin/env python3
"""Lists the boards on a CAN bus that no host uses yet, with the canbus_uuid for their [mcu] section.

    scripts/canbus_query.py can0

Boards that a host has started since they were switched on do not answer. Exit status: 0, 2 if the bus can not be used.
"""

from __future__ import annotations

import in_venv

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "klippy"))

from link import canport

WAIT_S = 2.0


def main(argv: Sequence[str] | None = None, open_bus: canport.OpenBus = canport.open_bus) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("interface", help="name of the CAN interface, as `ip link` shows it")
    parser.add_argument("--wait", type=float, default=WAIT_S, metavar="SECONDS", help="default %(default)s")
    args = parser.parse_args(argv)
    count = 0
    try:
        with open_bus(args.interface, canport.ADMIN_ID + 1) as bus:
            for uuid in canport.unassigned(bus, args.wait):
                count += 1
                print(f"Found canbus_uuid={uuid.hex()}", flush=True)
    except OSError as e:
        print(
            f"canbus_query.py: unable to use the interface '{args.interface}': {e.strerror}", file=sys.stderr
        )
        return 2
    print(f"Total {count} uuids found")
    return 0


if __name__ == "__main__":
    sys.exit(main())
