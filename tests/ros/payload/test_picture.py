"""`jpeg` and `png` of sensor_msgs/Image: what comes out is opened, and what is wrong is refused."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest
from images import converter_of, image

from appliance.config import ConfigError
from appliance.config.reading import loads
from appliance.mqtt.codec import Property
from appliance.ros.payload.converter import ConversionError, compile_converter
from appliance.ros.payload.definitions import (
    PRIMITIVES,
    Field,
    FieldType,
    Sequence,
    String,
    TypeDescription,
    UnknownTypeError,
)
from appliance.ros.payload.encodings import picture
from appliance.ros.payload.encodings.base import PictureOptions
from appliance.ros.payload.encodings.registry import ENCODINGS
from appliance.ros.payload.payloads import packer

Image = pytest.importorskip("PIL.Image")

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def made(encoding: str, cdr: bytes, options: PictureOptions | None = None):
    """The payload, opened by Pillow."""
    options = options or PictureOptions()
    payload, properties = packer(converter_of(), encoding, "none", [], options)(cdr)
    assert properties[Property.CONTENT_TYPE] == f"image/{encoding}"
    opened = Image.open(io.BytesIO(payload))
    assert opened.format == encoding.upper()
    opened.load()
    return opened


def stripes(*pixels: tuple[int, ...], width: int, height: int) -> bytes:
    """A third of each row has each of the three colours."""
    row = b"".join(bytes(pixel) * (width // 3) for pixel in pixels)
    return row * height


@pytest.mark.parametrize("encoding", ["jpeg", "png"])
@pytest.mark.parametrize(
    ("name", "order", "alpha"),
    [
        ("rgb8", (0, 1, 2), False),
        ("bgr8", (2, 1, 0), False),
        ("8UC3", (2, 1, 0), False),
        ("rgba8", (0, 1, 2), True),
        ("bgra8", (2, 1, 0), True),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_colours_are_right_side_up(
    encoding: str, name: str, order: tuple[int, ...], alpha: bool, padding: int
) -> None:
    width, height = 48, 32
    rows = bytearray()
    for y in range(height):
        colours = (RED, GREEN, BLUE) if y < height // 2 else (BLUE, BLUE, BLUE)
        pixels = [(*(c[n] for n in order), *((128,) if alpha else ())) for c in colours]
        rows += stripes(*pixels, width=width, height=1) + b"\xaa" * padding
    opened = made(encoding, image(bytes(rows), width, height, name))
    assert opened.size == (width, height)
    if encoding == "png":
        assert opened.mode == ("RGBA" if alpha else "RGB")
        assert not alpha or opened.getpixel((1, 1))[3] == 128
    for x, y, wanted in ((8, 4, RED), (24, 4, GREEN), (40, 4, BLUE), (8, 28, BLUE)):
        found = opened.convert("RGB").getpixel((x, y))
        near = 0 if encoding == "png" else 12
        assert all(abs(a - b) <= near for a, b in zip(found, wanted, strict=True)), (x, y, found)


@pytest.mark.parametrize("name", ["mono8", "8UC1"])
def test_gray_stays_gray(name: str) -> None:
    cdr = image(bytes(range(64)) * 32, 64, 32, name)
    assert made("jpeg", cdr).mode == "L"
    assert made("png", cdr).tobytes() == bytes(range(64)) * 32


@pytest.mark.parametrize("name", ["mono16", "16UC1"])
@pytest.mark.parametrize("big", [False, True])
def test_sixteen_bits(name: str, big: bool) -> None:
    depths = [n * 100 for n in range(64)]
    order = "big" if big else "little"
    data = b"".join(depth.to_bytes(2, order) for depth in depths) * 48
    cdr = image(data, 64, 48, name, big=big)
    opened = made("png", cdr)
    assert [opened.getpixel((x, 5)) for x in range(64)] == depths
    smaller = made("png", cdr, PictureOptions(max_width=32))  # no depth that nobody has measured
    assert {smaller.getpixel((x, 5)) for x in range(32)} < set(depths)
    scaled = made("jpeg", cdr)
    assert scaled.mode == "L"
    found = [scaled.getpixel((x, 20)) for x in range(64)]
    assert all(
        abs(value - depth * 255 / 6300) < 4 for value, depth in zip(found, depths, strict=True)
    )
    assert made("jpeg", image(bytes(2 * 64 * 48), 64, 48, name)).getextrema() == (0, 0)


def test_quality_and_size() -> None:
    data = bytes(n * n % 251 for n in range(640 * 480 * 3))
    cdr = image(data, 640, 480)

    def size(quality: int) -> int:
        return len(packer(converter_of(), "jpeg", "none", [], PictureOptions(quality))(cdr)[0])

    assert size(20) < size(80) < size(95)
    assert made("jpeg", cdr, PictureOptions(max_width=320)).size == (320, 240)
    assert made("png", cdr, PictureOptions(max_width=100)).size == (100, 75)
    assert made("jpeg", cdr, PictureOptions(max_width=2000)).size == (640, 480)
    assert made("png", image(bytes(3000 * 3), 3000, 1), PictureOptions(max_width=1)).size == (1, 1)


@pytest.mark.parametrize("encoding", ["jpeg", "png"])
@pytest.mark.parametrize(
    ("cdr", "why"),
    [
        (image(b"", 0, 1, step=0), "no pixels"),
        (image(b"", 3, 4, "rgb8", 9)[:-4] + bytes(4), "0 bytes, and 4 rows"),
        (image(bytes(35), 3, 4, "rgb8", 9), "35 bytes, and 4 rows of 9 bytes"),
        (image(bytes(37), 3, 4, "rgb8", 9), "37 bytes, and 4 rows"),
        (image(bytes(32), 3, 4, "rgb8", 8), "step: 8 bytes in a row, and 3 pixels of rgb8 have 9"),
        (image(bytes(32), 3, 4, "rgb8", 2**32 - 1), "32 bytes, and 4 rows"),
        (image(bytes(12), 2**32 - 1, 2**32 - 1, "rgb8", 3), "pixels are converted"),
        (image(bytes(12), 2**24 + 1, 1, "mono8", 12), "pixels are converted"),
        (image(bytes(12), 3, 4, "bayer_rggb8", 3), "bayer_rggb8.*image_proc"),
        (image(bytes(48), 3, 4, "32FC1", 12), "'32FC1' is not one of rgb8, bgr8"),
        (image(bytes(12), 3, 4, "x" * 5000, 3), "encoding: 'x{40}' is not"),
        (image(bytes(12), 3, 4, "", 3), "'' is not one of"),
        (image(bytes(36), 3, 4)[:40], None),
        (b"", None),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_no_image_is_refused_with_a_reason(
    encoding: str, cdr: bytes, why: str | None
) -> None:
    with pytest.raises(ConversionError, match=why) as refused:
        packer(converter_of(), encoding, "none", [])(cdr)
    assert len(str(refused.value)) < 300


def test_a_row_that_jpeg_cannot_have() -> None:
    cdr = image(bytes(70_000), 70_000, 1, "mono8")
    with pytest.raises(ConversionError, match="65500"):
        packer(converter_of(), "jpeg", "none", [])(cdr)
    assert made("png", cdr).size == (70_000, 1)
    assert made("jpeg", cdr, PictureOptions(max_width=1000)).size == (1000, 1)


@pytest.mark.parametrize("encoding", ["jpeg", "png"])
def test_other_types_and_the_way_to_ros_are_refused(
    encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    described = ENCODINGS[encoding]
    with pytest.raises(UnknownTypeError, match="cannot be built from"):
        described.check(converter_of(), to_ros=True)
    with pytest.raises(UnknownTypeError, match="goes as binary"):
        described.check(converter_of("sensor_msgs/msg/CompressedImage"), to_ros=False)
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(UnknownTypeError, match="needs Pillow: pip install Pillow"):
        described.check(converter_of(), to_ros=False)


@pytest.mark.parametrize("encoding", ["jpeg", "png"])
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("height", PRIMITIVES["float32"]),
        ("width", PRIMITIVES["int32"]),
        ("encoding", PRIMITIVES["uint8"]),
        ("step", Sequence(PRIMITIVES["uint32"])),
        ("data", String()),
        ("data", Sequence(PRIMITIVES["float32"])),
    ],
)
def test_a_type_with_the_names_of_an_image_only_is_refused(
    encoding: str, name: str, kind: FieldType
) -> None:
    fields = {field.name: field.type for field in converter_of().description.fields} | {name: kind}
    odd = TypeDescription("my_msgs/msg/Image", tuple(Field(*each) for each in fields.items()))
    with pytest.raises(UnknownTypeError, match=r"only sensor_msgs/msg/Image"):
        ENCODINGS[encoding].check(compile_converter(odd), to_ros=False)


def test_a_png_of_too_many_pixels_is_refused_before_it_is_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert made("png", image(bytes(1920 * 1080 * 4), 1920, 1080, "rgba8")).size == (1920, 1080)
    cdr = image(bytes(4096 * 4096), 4096, 4096, "mono8")
    assert made("png", cdr, PictureOptions(max_width=2048)).size == (2048, 2048)
    narrow = image(bytes(picture.LARGEST_PNG // 2 + 1), 1, picture.LARGEST_PNG // 2 + 1, "mono8")
    monkeypatch.delattr(picture, "_load")
    for each in (cdr, narrow):
        with pytest.raises(ConversionError, match="set max_width, or use jpeg"):
            packer(converter_of(), "png", "none", [])(each)
    with pytest.raises(ConversionError, match="65500"):
        packer(converter_of(), "jpeg", "none", [])(narrow)


@pytest.mark.parametrize("encoding", ["jpeg", "png"])
def test_a_picture_that_becomes_too_large_is_refused(
    encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cdr = image(bytes(48 * 32 * 3), 48, 32)
    monkeypatch.setattr(picture, "LARGEST_PICTURE", 50)
    with pytest.raises(ConversionError, match="and 50 are the most: set max_width"):
        packer(converter_of(), encoding, "none", [])(cdr)


def test_without_memory_files_it_is_a_file_or_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    cdr = image(bytes(48 * 32 * 3), 48, 32)
    monkeypatch.delattr(picture.os, "memfd_create")
    assert made("jpeg", cdr).size == (48, 32)
    monkeypatch.setattr(picture.tempfile, "tempdir", "/nowhere/at/all")
    assert made("png", cdr).size == (48, 32)


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        ("to: ros, encoding: jpeg", "encoding: jpeg is for routes to MQTT only"),
        ("to: both, encoding: png", "encoding: png is for routes to MQTT only"),
        ("to: mqtt, quality: 50", "quality: is for jpeg only, and the encoding is json"),
        ("to: mqtt, encoding: png, quality: 50", "quality: is for jpeg only"),
        ("to: mqtt, max_width: 50", "max_width: is for jpeg and png only"),
        ("to: mqtt, encoding: jpeg, quality: 96", "quality: "),
        ("to: mqtt, encoding: jpeg, max_width: 0", "max_width: "),
        ("to: mqtt, encoding: jpeg, fields: [data]", "fields: is for json and cbor only"),
    ],
)
def test_keys_that_do_not_fit_the_encoding(keys: str, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        loads(f"bridge: {{topics: [{{ros: /image, {keys}}}]}}", Path("appliance.yaml"), {})
