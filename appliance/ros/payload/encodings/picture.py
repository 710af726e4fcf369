"""`jpeg` and `png`: the picture in a sensor_msgs/Image, compressed, and smaller if wanted.

Pillow does it. It is imported when a route needs it, and need not be installed otherwise. Nothing
is known of who publishes the image: its size is checked before anything of that size is made.
"""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import IO, TYPE_CHECKING, Any, NamedTuple

from appliance.ros.payload.codegen import MISFIT, generate_binary
from appliance.ros.payload.converter import Converter
from appliance.ros.payload.definitions import (
    PRIMITIVES,
    FieldType,
    Sequence,
    String,
    UnknownTypeError,
)
from appliance.ros.payload.encodings.base import Decode, Encode, Encoding, PictureOptions
from appliance.ros.payload.fallback import ConversionError
from appliance.ros.payload.fallback import decode as decode_slowly

if TYPE_CHECKING:
    from PIL.Image import Image

#: The fields of sensor_msgs/Image that make the picture, and their types.
FIELDS: dict[str, FieldType] = {
    "height": PRIMITIVES["uint32"],
    "width": PRIMITIVES["uint32"],
    "encoding": String(),
    "is_bigendian": PRIMITIVES["uint8"],
    "step": PRIMITIVES["uint32"],
    "data": Sequence(PRIMITIVES["uint8"]),
}

#: The most pixels of an image that is converted: 4096 × 4096. Of noise, the worst, a JPEG took 250
#: to 720 ms of a processor, the longer time with `max_width: 4095`.
LARGEST_PIXELS = 16 * 1024 * 1024

#: The most bytes of pixels that PNG compresses, after the picture was made smaller, with the byte
#: before each row: 1920 × 1080 with an alpha channel. Of noise, the worst, they took 460 to 650 ms.
LARGEST_PNG = 8 * 1024 * 1024

#: The most bytes of a converted picture: 4096 × 4096 pixels of noise are 11 MB as JPEG of quality
#: 80, and 20 MB of 95, of which the mailbox could not even hold those of four topics.
LARGEST_PICTURE = 16 * 1024 * 1024

#: The most pixels that JPEG has in a row or a column.
LARGEST_JPEG = 65_500

#: zlib's level for PNG: higher ones take half as long again for a tenth of the bytes.
PNG_LEVEL = 1

#: What a reader has to have installed.
MISSING = (
    "needs Pillow: pip install Pillow in the appliance's environment, or Debian's python3-pil "
    "where that has the computer's packages"
)


class _Pixels(NamedTuple):
    """How the pixels of one of ROS's encodings lie, in Pillow's words.

    `mode` is what they become, `raw` what they are; without an alpha channel, where JPEG has none,
    they are `opaque`. Of 16-bit ones `raw` is in little endian; `big` is the other.
    """

    size: int  # bytes
    mode: str
    raw: str
    opaque: str = ""
    big: str = ""


#: ROS's encodings (sensor_msgs/image_encodings.hpp), and OpenCV's names of the same.
PIXELS = {
    "rgb8": _Pixels(3, "RGB", "RGB"),
    "bgr8": _Pixels(3, "RGB", "BGR"),
    "8UC3": _Pixels(3, "RGB", "BGR"),
    "rgba8": _Pixels(4, "RGBA", "RGBA", "RGBX"),
    "bgra8": _Pixels(4, "RGBA", "BGRA", "BGRX"),
    "8UC4": _Pixels(4, "RGBA", "BGRA", "BGRX"),
    "mono8": _Pixels(1, "L", "L"),
    "8UC1": _Pixels(1, "L", "L"),
    "mono16": _Pixels(2, "I;16", "I;16", big="I;16B"),
    "16UC1": _Pixels(2, "I;16", "I;16", big="I;16B"),
}


@dataclass(frozen=True)
class Picture(Encoding):
    """A picture of an image; of one type, and to MQTT only."""

    name: str
    content_type: str
    options: PictureOptions
    is_slow = True

    def with_picture(self, options: PictureOptions) -> Encoding:
        return replace(self, options=options)

    def check(self, converter: Converter, *, to_ros: bool) -> None:
        description = converter.description
        if to_ros:
            raise UnknownTypeError(f"{description.name} cannot be built from {self.name}")
        types = {field.name: field.type for field in description.fields}
        if any(types.get(name) != wanted for name, wanted in FIELDS.items()):
            hint = "; a CompressedImage goes as binary" if "Compressed" in description.name else ""
            raise UnknownTypeError(
                f"{description.name} cannot go as {self.name}: only sensor_msgs/msg/Image{hint}"
            )
        try:
            import PIL.Image  # noqa: F401
        except ImportError:
            raise UnknownTypeError(f"{self.name} {MISSING}") from None

    def encoder(self, converter: Converter) -> Encode:
        self.check(converter, to_ros=False)
        description = converter.description
        read = generate_binary(description, dict.fromkeys(FIELDS)).decode
        write = self._jpeg if self.name == "jpeg" else self._png

        def encode(cdr: bytes) -> bytes:
            try:
                image = read(cdr)
            except MISFIT:
                image = decode_slowly(description, cdr, binary=True)
            return write(image)

        return encode

    def decoder(self, converter: Converter, items: int) -> Decode:
        self.check(converter, to_ros=True)
        raise AssertionError

    def _jpeg(self, image: dict[str, Any]) -> bytes:
        pixels = check_image(image)
        if max(self._size(image["width"], image["height"])) > LARGEST_JPEG:
            raise ConversionError("", f"JPEG has at most {LARGEST_JPEG} pixels in a row or column")
        picture = _load(image, pixels, has_alpha=False)
        if picture.mode == "I;16":
            picture = _eight_bits(picture)
        picture = self._fitted(picture)
        return _saved(lambda file: picture.save(file, "JPEG", quality=self.options.quality))

    def _png(self, image: dict[str, Any]) -> bytes:
        pixels = check_image(image)
        width, height = self._size(image["width"], image["height"])
        size = height * (1 + width * pixels.size)
        if size > LARGEST_PNG:
            problem = f"{width} × {height} pixels of {image['encoding']} have {size} bytes: of at "
            problem += f"most {LARGEST_PNG} PNG is made; set max_width, or use jpeg"
            raise ConversionError("width", problem)
        picture = self._fitted(_load(image, pixels, has_alpha=True))
        return _saved(lambda file: picture.save(file, "PNG", compress_level=PNG_LEVEL))

    def _size(self, width: int, height: int) -> tuple[int, int]:
        """The width and height of the picture, in pixels."""
        most = self.options.max_width
        if most is None or width <= most:
            return width, height
        return most, max(1, round(height * most / width))

    def _fitted(self, picture: Image) -> Image:
        """The picture, no wider than is wanted."""
        size = self._size(*picture.size)
        if size == picture.size:
            return picture
        from PIL.Image import Resampling

        if picture.mode == "I;16":  # depths: what is between two of them is none
            return picture.resize(size, Resampling.NEAREST)
        return picture.resize(size, Resampling.BILINEAR, reducing_gap=2.0)


def check_image(image: dict[str, Any]) -> _Pixels:
    """How its pixels lie. Raises ConversionError when the fields of the image do not fit each
    other, or it is one that cannot be converted."""
    width, height, step = image["width"], image["height"], image["step"]
    encoding, size = image["encoding"], len(image["data"])
    pixels = PIXELS.get(encoding)
    if pixels is None:
        hint = "; image_proc makes bgr8 of it" if encoding.startswith("bayer_") else ""
        known = ", ".join(PIXELS)
        raise ConversionError("encoding", f"{encoding[:40]!r} is not one of {known}{hint}")
    if not width or not height:
        raise ConversionError("width", f"{width} × {height}: it has no pixels")
    if width * height > LARGEST_PIXELS:
        problem = f"{width} × {height}: at most {LARGEST_PIXELS} pixels are converted"
        raise ConversionError("width", problem)
    if step < width * pixels.size:
        problem = f"{step} bytes in a row, and {width} pixels of {encoding} have "
        raise ConversionError("step", problem + str(width * pixels.size))
    if size != step * height:
        problem = f"{size} bytes, and {height} rows of {step} bytes (step) have {step * height}"
        raise ConversionError("data", problem)
    return pixels


def _load(image: dict[str, Any], pixels: _Pixels, *, has_alpha: bool) -> Image:
    """The image as Pillow's."""
    from PIL.Image import frombytes

    mode, raw = pixels.mode, pixels.raw
    if pixels.opaque and not has_alpha:
        mode, raw = "RGB", pixels.opaque
    if pixels.big and image["is_bigendian"]:
        raw = pixels.big
    size = (image["width"], image["height"])
    return frombytes(mode, size, image["data"], "raw", raw, image["step"], 1)


def _eight_bits(picture: Image) -> Image:
    """A picture of 16 bits with its largest value as white: depths in millimetres are visible."""
    _, most = picture.getextrema()
    scale = 255 / most if isinstance(most, (int, float)) and most else 0.0
    return picture.point(lambda value: value * scale + 0).convert("L")


def _saved(save: Callable[[IO[bytes]], None]) -> bytes:
    """What is written to a file: into one Pillow writes without the interpreter's lock, so that the
    event loop goes on meanwhile, into memory it writes JPEG with it.

    Raises ConversionError when it is too large.
    """
    with _file() as file:
        save(file)
        size = file.seek(0, os.SEEK_END)
        if size > LARGEST_PICTURE:
            problem = f"the picture has {size} bytes, and {LARGEST_PICTURE} are the most: set "
            raise ConversionError("", problem + "max_width or a lower quality")
        file.seek(0)
        return file.read()


def _file() -> IO[bytes]:
    try:
        return open(os.memfd_create("picture"), "w+b")  # noqa: PTH123 - Linux's, in memory
    except (AttributeError, OSError):
        try:
            return tempfile.TemporaryFile()
        except OSError:
            return io.BytesIO()


JPEG = Picture("jpeg", "image/jpeg", PictureOptions())
PNG = Picture("png", "image/png", PictureOptions())
