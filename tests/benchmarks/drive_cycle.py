"""Time of one drive's cycle: receive RPDO2, consume SYNC, send TPDO1. Run: python tests/benchmarks/drive_cycle.py"""

import struct
import time

from emulator.axis import Measurement
from emulator.drive import Drive
from protocols import cia402, nmt
from protocols.frames import Frame
from protocols.robot import Drive as Config

CYCLES = 100_000
PERIOD_NS = 1_000_000


def main() -> None:
    drive = Drive(Config(gear_ratio=-32.0, drive_gain_Nm_A=10.0, rated_current_A=2.0, max_current_A=8.0), 5)
    drive.start(0)
    drive.receive(0, nmt.command(nmt.Command.START))
    for word in (0x06, 0x07, 0x0F):
        drive.receive(0, Frame(nmt.rpdo_id(1, 5), struct.pack("<Hb", word, cia402.Mode.CST)))
    targets = [Frame(nmt.rpdo_id(2, 5), struct.pack("<hi", n % 900, n)) for n in range(CYCLES)]
    measurements = [Measurement(n, 3 * n, 1e-4 * n % 2) for n in range(CYCLES)]
    sent = 0
    start = time.process_time_ns()
    for n in range(CYCLES):
        t_ns = n * PERIOD_NS
        drive.receive(t_ns, targets[n])
        sent += len(drive.on_sync(t_ns, n % 240 + 1, measurements[n]))
        drive.command()
        drive.tick(t_ns)
    elapsed = time.process_time_ns() - start
    if drive.state is not cia402.State.OPERATION_ENABLED or sent < CYCLES:
        raise SystemExit(f"the drive did not run: {drive.state}, {sent} frames sent")
    print(f"{elapsed / CYCLES / 1000:.2f} us per drive and cycle ({sent} frames sent)")


if __name__ == "__main__":
    main()
