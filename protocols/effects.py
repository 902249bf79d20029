"""Names of the physical effects that files, flags and results share. Names only: the equations exist twice,
once in `emulator` (what happens) and once in `ident` (what is supposed), written independently."""

from typing import Literal, get_args

Effect = Literal[
    "friction.stribeck",
    "friction.asymmetric",
    "friction.viscous_nonlinear",
    "friction.load",
    "friction.temperature",
    "friction.presliding",
    "friction.position",
    "transmission.elasticity",
    "transmission.backlash",
    "transmission.efficiency",
    "transmission.coupling",
    "motor.ripple",
    "motor.saturation",
    "drive.gain",
    "drive.delay",
    "drive.current_offset",
    "sensor.eccentricity",
    "spring",
    "payload",
    "base.tilt",
    "base.flexibility",
    "contact",
    "disturbance.periodic",
    "unlisted",
]

EFFECTS: tuple[str, ...] = get_args(Effect)
