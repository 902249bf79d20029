"""`explain` on public recordings of three machines: what was left out, and the error on motion kept back.

    python tests/studies/explain_real.py [emps] [tx40] [cogging]

Reads them in place (ARMRIG_SHARED names their folder; see its README for the sources). Nothing is fitted to the part
that is kept back.
"""

import os
import sys
from pathlib import Path

import msgspec
import numpy as np

from ident.dataset import Signals
from ident.explain import judge, motion, rows
from ident.explain.explain import Answer, explain
from ident.explain.motion import Run
from ident.explain.printout import render
from protocols.robot import Control, Drive, Joint, Parameters, Robot, load

SHARED = Path(os.environ.get("ARMRIG_SHARED", Path(__file__).parents[2] / "shared")) / "data"
BENCHMARK_HZ = 40.0  # rows of the figures that others published for EMPS and TX40
TX40_END_S, TX40_SHARE = 7.5, 0.6


def emps(name: str) -> Signals:
    """Force = 35.1507 N/V times the controller's output, which the drive follows later."""
    table = np.loadtxt(SHARED / "emps" / f"emps_{name}.csv", delimiter=",", skiprows=1)
    t = np.arange(len(table)) * 0.001
    return Signals(f"emps {name}", ["carriage"], t, table[:, [1]], 35.1507 * table[:, [2]], np.zeros(1))


def tx40(start_s: float, end_s: float) -> Signals:
    folder = SHARED / "tx40"
    angle, torque = (
        np.loadtxt(folder / f"tx40_motor_{what}_5kHz.csv", delimiter=",", skiprows=1) for what in ("pos", "torque")
    )
    R = np.diag([32.0, 32, 45, -48, 45, 32])
    R[5, 4] = 32
    q = angle @ np.linalg.inv(R).T + np.array([0, -np.pi / 2, np.pi / 2, 0, 0, 0])
    t = np.arange(len(q)) * 0.0002
    kept = (t >= start_s) & (t < end_s)
    names = [f"joint{j}" for j in range(1, 7)]
    return Signals(f"tx40 {start_s:g} to {end_s:g} s", names, t[kept], q[kept], (torque @ R)[kept], np.zeros(6))


def tx40_robot() -> Robot:
    robot = load("tx40")  # the recording's angles contain theta0
    return msgspec.structs.replace(robot, joint=[msgspec.structs.replace(j, theta0_rad=0.0) for j in robot.joint])


def cogging(name: str) -> Signals:
    """In ampere, on a regular grid (its time stamps are not)."""
    table = np.loadtxt(SHARED / "cogging" / f"odrive_{name}.csv", delimiter=",", skiprows=1)
    t = np.arange(table[0, 0], table[-1, 0], 1 / 430)
    angle, current = (np.interp(t, table[:, 0], table[:, k]) for k in (1, 2))
    return Signals(name, ["motor"], t, 2 * np.pi / 8192 * angle[:, None], current[:, None], np.zeros(1))


def cogging_robot() -> Robot:
    drive = Drive(
        gear_ratio=1.0, drive_gain_Nm_A=1.0, rated_current_A=5.0, max_current_A=10.0, encoder_counts_per_rev=8192
    )
    joint = Joint(
        name="motor",
        position_min_rad=-7.0,
        position_max_rad=7.0,
        velocity_max_rad_s=5.0,
        torque_max_Nm=10.0,
        drive=drive,
        control=Control(natural_frequency_rad_s=50.0, inertia_kgm2=0.01),
        parameters=Parameters(rotor_inertia_kgm2=0.003),
    )
    return Robot(name="ODrive motor, ampere for N·m", gravity_m_s2=(0.0, 0.0, 0.0), joint=[joint])


def at_benchmark_rate(answer: Answer, unseen: Signals) -> None:
    """The error on all rows at the rate that others judged at."""
    saved = rows.AXIS_HZ, rows.ARM_HZ
    rows.AXIS_HZ = rows.ARM_HZ = BENCHMARK_HZ
    names = answer.scene.model.robot.joint_names
    views = answer.models.views(motion.motions([Run(unseen)], names, fold=False))
    levels = judge.torque_errors(judge.residuals(answer.models, views))
    rows.AXIS_HZ, rows.ARM_HZ = saved
    per_joint = ", ".join(f"{a:.1f} -> {b:.1f}" for a, b in levels.per_joint if a is not None and b is not None)
    print(f"{BENCHMARK_HZ:g} Hz rows, kept back: {levels.refitted:.2f} -> {levels.explained:.2f} % ({per_joint})\n")


def centred(answer: Answer, unseen: Signals) -> None:
    """Share of the centred current that is not explained, at the full rate of the recording."""
    models = answer.models
    (view,) = models.views(motion.motions([Run(unseen)], ["motor"], fold=False))
    r = judge.scenes.regressor(models.scene.model, view.motion, models.scene.soft)
    left = [view.motion.tau_Nm[:, 0] - (r @ theta)[0] for theta in (models.refitted, models.explained)]
    left[1] = left[1] - models.extra_torque(view)[:, 0]
    size = np.linalg.norm(view.motion.tau_Nm[:, 0] - view.motion.tau_Nm[:, 0].mean())
    before, after = (100 * np.linalg.norm(x) / size for x in left)
    print(f"kept back: {before:.1f} -> {after:.1f} % of the centred current\n")


def main(wanted: list[str]) -> None:
    if "emps" in wanted:
        answer = explain([Run(emps("train"))], load("emps"), [Run(emps("pulses"))])
        print(render(answer.explanation))
        at_benchmark_rate(answer, emps("pulses"))
    if "tx40" in wanted:
        middle = 0.1 + TX40_SHARE * (TX40_END_S - 0.1)
        unseen = tx40(middle, TX40_END_S)
        answer = explain([Run(tx40(0.1, middle))], tx40_robot(), [Run(unseen)])
        print(render(answer.explanation))
        at_benchmark_rate(answer, unseen)
    if "cogging" in wanted:
        answer = explain(
            [Run(cogging("slow_nocomp_0")), Run(cogging("slow_nocomp_1"), 20.0)],
            cogging_robot(),
            [Run(cogging("slow_nocomp_2"))],
        )
        print(render(answer.explanation))
        centred(answer, cogging("slow_nocomp_2"))


if __name__ == "__main__":
    main(sys.argv[1:] or ["emps", "tx40", "cogging"])
