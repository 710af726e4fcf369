"""What the demo robot sees; that it publishes it is in tests/web/test_camera_page.py."""

from __future__ import annotations

import math

import pytest

from appliance.cli.demo_robot import ROOM

pytest.importorskip("numpy")

from appliance.cli import demo_scene as scene


def pixel(pixels, column, row):
    at = 3 * (row * scene.WIDTH + column)
    return tuple(pixels[at : at + 3])


def wall_height(pixels):
    """Rows of the wall in the middle of the picture, between the sky and the floor."""
    middle = scene.WIDTH // 2
    outside = {pixel(pixels, middle, 0), pixel(pixels, middle, scene.HEIGHT - 1)}
    return sum(pixel(pixels, middle, row) not in outside for row in range(scene.HEIGHT))


def test_a_picture_has_its_size_wherever_the_robot_is():
    places = [(0, 0, 0), (ROOM / 2, 0, 0), (ROOM / 2, ROOM / 2, math.pi), (-1e6, 1e6, -math.pi / 2)]
    for x, y, heading in places:
        assert len(scene.picture(ROOM, x, y, heading, 1e9)) == 3 * scene.WIDTH * scene.HEIGHT


def test_a_wall_grows_when_the_robot_drives_to_it():
    far, near = (scene.picture(ROOM, x, 0.1, 0.0, 4.0) for x in (-1.0, 1.0))
    assert 0 < wall_height(far) < wall_height(near)


def test_the_picture_turns_with_the_robot_and_moves_by_itself():
    first = scene.picture(ROOM, 0.0, 0.0, 0.0, 0.0)
    assert scene.picture(ROOM, 0.0, 0.0, 0.0, 0.0) == first
    assert scene.picture(ROOM, 0.0, 0.0, 0.3, 0.0) != first
    assert scene.picture(ROOM, 0.0, 0.0, 0.0, 1.0) != first


def test_the_walls_of_the_map_are_where_the_scanner_sees_them():
    cells = scene.map_cells(ROOM)
    side = math.isqrt(len(cells))
    assert side * side == len(cells) and set(cells) == {scene.FREE, scene.OCCUPIED}

    def cell(x, y):
        column, row = (
            math.floor((each - scene.map_corner(ROOM)) / scene.RESOLUTION) for each in (x, y)
        )
        return cells[row * side + column]

    half = ROOM / 2 + scene.RESOLUTION / 4
    assert [cell(half, 0.3), cell(0.3, half), cell(0.3, -half + scene.RESOLUTION)] == [100] * 3
    assert [cell(0, 0), cell(half - 0.2, 0.3), cell(ROOM, ROOM)] == [0] * 3
