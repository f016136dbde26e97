"""A program as a CAM writes it: a conical pocket with rounded corners, roughed in layers by EDM."""

import math
from collections.abc import Iterator

_LAYER = 0.05
_CORNER = 3.0
_HALF_WIDTH, _HALF_DEPTH = 12.0, 8.0
_TAPER = 0.2
_POINTS_A_TURN = 120
_SAFE_Z = 5.0


def sample_program(size: int) -> list[str]:
    """Return a program of about `size` commands, comments among them, at least one layer.

    The path is deterministic; each layer is one closed turn, lower and a little smaller than the one before.
    """
    lines = [
        "; conical pocket, electrode 1.0 mm copper",
        f"; about {size} moves in layers of {_LAYER} mm",
        "G21 ; millimetres",
        "G90 ; absolute",
        f"G0 Z{_SAFE_Z:.3f}",
        f"G0 X{_HALF_WIDTH:.3f} Y0.000",
        "M3 P500 Q20 R25 ; pulses on",
    ]
    for layer in range(max(1, size // _POINTS_A_TURN)):
        depth = (layer + 1) * _LAYER
        shrink = depth * _TAPER
        lines.append(f"; layer {layer + 1}, Z-{depth:.3f}")
        lines.append(f"G1 Z-{depth:.3f}")
        lines += [f"G1 X{x:.3f} Y{y:.3f}" for x, y in _turn(max(0.5, 1 - shrink / _HALF_DEPTH))]
    lines += ["M5 ; pulses off", f"G0 Z{_SAFE_Z:.3f}", "G0 X0.000 Y0.000"]
    return lines


def _turn(scale: float) -> Iterator[tuple[float, float]]:
    """Yield the points of one turn round a superellipse, which has no sharp corner."""
    for point in range(1, _POINTS_A_TURN + 1):
        angle = 2 * math.pi * point / _POINTS_A_TURN
        cos, sin = math.cos(angle), math.sin(angle)
        yield (
            scale * _HALF_WIDTH * math.copysign(abs(cos) ** (2 / _CORNER), cos),
            scale * _HALF_DEPTH * math.copysign(abs(sin) ** (2 / _CORNER), sin),
        )
