"""Motion a drive makes up by itself: position and velocity that change under limited acceleration, step by step."""

import math


class Profile:
    """A point that moves, one plant period per call.

    Attributes:
        position: [counts].
        velocity: At the end of the last step [counts/s].
    """

    __slots__ = ("position", "velocity")

    def __init__(self, position: float = 0.0, velocity: float = 0.0) -> None:
        self.position = position
        self.velocity = velocity

    def set(self, position: float, velocity: float = 0.0) -> None:
        self.position = position
        self.velocity = velocity

    def toward(self, target: float, speed: float, acceleration: float, deceleration: float, dt_s: float) -> bool:
        """Go to a position and stop there; true once it is reached.

        Trapezoidal: the speed is the largest from which the rest of the way suffices to stop, checked for the end of
        the step, so that the target is never overrun.
        """
        way = target - self.position
        sign = -1.0 if way < 0 or (way == 0 and self.velocity > 0) else 1.0
        d, v = sign * way, sign * self.velocity
        change = deceleration * dt_s
        if d <= change * dt_s / 2 and abs(v) <= change:
            self.set(target)
            return True
        braking = -change / 2 + math.sqrt(max(0.0, change * change / 4 + deceleration * (2 * d - v * dt_s)))
        fastest = v + (change if v < 0 else acceleration * dt_s)
        end = max(min(speed, braking, fastest), v - change)
        self._move(sign * end, dt_s)
        return False

    def at_speed(self, speed: float, acceleration: float, deceleration: float, dt_s: float) -> bool:
        """Change to a speed; true once it is reached."""
        v = self.velocity
        slowing = speed * v < 0 or abs(speed) < abs(v)
        rate = deceleration if slowing else acceleration
        self._move(v + max(-rate * dt_s, min(rate * dt_s, speed - v)), dt_s)
        return self.velocity == speed

    def stop(self, deceleration: float, dt_s: float) -> bool:
        """Slow down; true at rest."""
        v = self.velocity
        if abs(v) <= deceleration * dt_s:  # comes to rest within the step
            self.set(self.position + math.copysign(v * v / (2 * deceleration), v))
            return True
        self._move(v - math.copysign(deceleration * dt_s, v), dt_s)
        return False

    def _move(self, velocity: float, dt_s: float) -> None:
        self.position += (self.velocity + velocity) / 2 * dt_s
        self.velocity = velocity


class Settled:
    """Whether an error has stayed within a window for a time: the rule of 0x6067 and 0x6068, and others like them."""

    __slots__ = ("_inside_s", "reached")

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        self._inside_s = 0.0
        self.reached = False

    def step(self, error: float, window: float, time_ms: float, dt_s: float) -> bool:
        if abs(error) > window:
            self.clear()
        else:
            self._inside_s += dt_s
            self.reached = 1000 * self._inside_s >= time_ms
        return self.reached
