"""What the demo robot sees: a picture of its room, and the map of it.

Square rooms lie side by side without end, and the robot drives through their walls: there is always
one in sight. The first room has the origin in its middle. It needs numpy, which comes with ROS 2.
"""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np

WIDTH, HEIGHT = 320, 240  # pixels of a picture
FIELD_OF_VIEW = math.radians(80)
_STRIPE = 0.5  # m, of the walls' pattern
_WALL = 1.2  # m
_SUN = 14  # pixels, its radius
_SUN_PERIOD = 8.0  # seconds in which it crosses the sky

RESOLUTION = 0.05  # m, the side of a cell of the map
_ROOMS = 3  # along each side of the map
FREE, OCCUPIED = 0, 100

_COLUMNS = np.arange(WIDTH)
_ROWS = np.arange(HEIGHT)[:, None]
#: The angle of each column to the direction in which the robot looks, left to right.
_ANGLES = np.arctan((1 - 2 * (_COLUMNS + 0.5) / WIDTH) * math.tan(FIELD_OF_VIEW / 2))
_FOCUS = WIDTH / 2 / math.tan(FIELD_OF_VIEW / 2)  # pixels
_SKY, _FLOOR = (150, 190, 225), (95, 95, 90)
#: Of the walls ahead in x and in y, each in two colours.
_COLOURS = np.array([[(190, 90, 60), (225, 140, 95)], [(60, 110, 90), (110, 165, 130)]])


def picture(room: float, x: float, y: float, heading: float, now: float) -> array[int]:
    """The pixels (rgb8, row by row) that a camera sees there; the rooms have sides of `room` m.

    `x` and `y` are in m, `heading` in rad, `now` in seconds.
    """
    angles = heading + _ANGLES
    cos, sin = np.cos(angles), np.sin(angles)
    to_x, to_y = _to_wall(room, x, cos), _to_wall(room, y, sin)
    distance = np.minimum(to_x, to_y)
    is_across = to_y < to_x
    along = np.where(is_across, x + distance * cos, y + distance * sin)
    stripe = np.floor(along / _STRIPE).astype(int) % 2
    depth = np.maximum(distance * np.cos(_ANGLES), 0.05)
    shade = 1 / (1 + 0.12 * depth)
    walls = (_COLOURS[is_across.astype(int), stripe] * shade[:, None]).astype(np.uint8)
    half = _FOCUS * _WALL / 2 / depth
    pixels = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    pixels[: HEIGHT // 2] = _SKY
    pixels[HEIGHT // 2 :] = _FLOOR
    left = now % _SUN_PERIOD / _SUN_PERIOD * WIDTH
    pixels[(_COLUMNS - left) ** 2 + (_ROWS - 24) ** 2 < _SUN**2] = (250, 215, 80)
    is_wall = np.abs(_ROWS - HEIGHT / 2) < half
    np.copyto(pixels, walls[None], where=is_wall[:, :, None])
    return array("B", pixels.tobytes())


def map_cells(room: float) -> array[int]:
    """The cells of a map of 3 × 3 rooms, row by row from its corner at `map_corner`."""
    per_room = round(room / RESOLUTION)
    side = per_room * _ROOMS
    cells = np.full((side, side), FREE, np.int8)
    cells[::per_room] = cells[:, ::per_room] = OCCUPIED
    cells[-1] = cells[:, -1] = OCCUPIED
    return array("b", cells.tobytes())


def map_corner(room: float) -> float:
    """The x and the y of the map's corner, in m."""
    return -room * _ROOMS / 2


def _to_wall(room: float, position: float, direction: Any) -> Any:
    """How far it is to the next wall across an axis, for each direction along it."""
    within = (position + room / 2) % room - room / 2
    with np.errstate(divide="ignore"):
        return (np.copysign(room / 2, direction) - within) / direction
