"""Cost of one emulated millisecond of the TX40, without effects, with each, with a typical set and with all of them.

    python tests/benchmarks/effects.py

Prints microseconds of processor time per period, the best of several repetitions; ratios hold on a busy machine.
"""

from time import process_time

import msgspec
import numpy as np

from emulator.machine import load_machine
from emulator.plant import Plant
from protocols.effectentries import parse_effect
from protocols.effectparams import EFFECT_KINDS
from protocols.rig import load_rig
from protocols.robot import Robot

PERIOD_S, PERIODS, REPETITIONS = 1e-3, 1000, 5
TYPICAL = (
    "friction.stribeck@joint1",
    "friction.presliding@joint2",
    "transmission.elasticity@joint3",
    "motor.ripple@joint4",
    "friction.temperature@joint5",
    "drive.delay",
)


def cost_us(robot: Robot) -> float:
    """One period in CSP on sines, [us]."""
    J = robot.joints
    plant = Plant(robot, PERIOD_S, np.random.default_rng(1), np.full(J, 0.1), np.full(J, 1e-6))
    t = PERIOD_S * np.arange(PERIODS * REPETITIONS)
    targets = robot.motor_counts(0.5 * np.sin(2 * np.pi * np.outer(t, 0.3 + 0.05 * np.arange(J))))
    mode, unused, best = np.full(J, 8), np.zeros(J), np.inf
    plant.advance(mode, targets[0], unused)  # compiles
    for rows in np.split(targets, REPETITIONS):
        begin = process_time()
        for target in rows:
            plant.advance(mode, target, unused)
        best = min(best, (process_time() - begin) / PERIODS)
    return 1e6 * best


def main() -> None:
    machine = load_machine(*load_rig("tx40-rig"))
    plain = cost_us(machine)
    print(f"{'none':24s} {plain:6.1f} us")
    sets = {key: [f"{key}@joint2" if kind.place != "arm" else key] for key, kind in EFFECT_KINDS.items()}
    sets["a typical six"] = list(TYPICAL)
    sets["all on all joints"] = [
        f"{key}@{joint}" if kind.place != "arm" else key
        for key, kind in EFFECT_KINDS.items()
        for joint in (machine.joint_names[1:] if kind.place != "arm" else [""])
    ]
    for name, texts in sets.items():
        us = cost_us(msgspec.structs.replace(machine, effect=[parse_effect(text) for text in texts]))
        print(f"{name:24s} {us:6.1f} us   {us / plain:4.2f} times none")


if __name__ == "__main__":
    main()
