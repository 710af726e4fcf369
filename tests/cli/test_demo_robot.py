"""The demo robot's motion and its scanner; the node itself runs in tests/ros/ros2/test_ros2.py."""

from __future__ import annotations

import math

import pytest

from appliance.cli.demo_robot import ROOM, SCAN_POINTS, Drive


def drive_for(drive, seconds, start=0.0, step=0.05):
    for number in range(1, round(seconds / step) + 1):
        drive.advance(step, start + number * step)


def test_drives_straight_and_stops_without_commands():
    drive = Drive()
    drive.command(1.0, 0.0, now=0.0)
    drive_for(drive, 0.5)
    assert (drive.x, drive.y) == pytest.approx((0.5, 0.0))
    drive_for(drive, 5.0, start=0.5)
    assert drive.linear == 0.0
    assert 0.9 < drive.x < 1.1


def test_drives_a_quarter_circle():
    drive = Drive()
    drive.command(math.pi / 2, math.pi / 2, now=0.0)  # radius 1 m
    drive_for(drive, 1.0, step=0.01)
    assert (drive.x, drive.y, drive.heading) == pytest.approx((1.0, 1.0, math.pi / 2), abs=0.02)


def test_what_is_not_a_number_stops():
    drive = Drive()
    drive.command(1.0, 0.0, now=0.0)
    drive.command(math.nan, 0.0, now=0.1)
    drive_for(drive, 1.0)
    assert (drive.x, drive.linear) == (0.0, 0.0)


def test_scan_sees_the_walls():
    drive = Drive()
    ranges = drive.scan()
    assert len(ranges) == SCAN_POINTS
    assert [ranges[i * SCAN_POINTS // 4] for i in range(4)] == pytest.approx([ROOM / 2] * 4)
    drive.x = ROOM * 10 + 0.5
    assert drive.scan()[0] == pytest.approx(ROOM / 2 - 0.5)
    assert all(0 < distance <= ROOM * math.sqrt(2) for distance in drive.scan())
