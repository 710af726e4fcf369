"""Generates Python source for one message type: `decode` and `encode`, from and to its bytes.

Everything that the type determines is computed here, once a type. Neighbouring numbers are read and
written by one precompiled `struct.Struct` (a *run*), nested messages are flattened, and padding is
part of the run. CDR aligns a number to its size, counted from the end of the four bytes of header.
While the position modulo 8 is known, a run has one layout. After a string it has up to eight, and
the position selects one of them. ROS 1 aligns nothing, so that every run has one layout there.

When only some fields of a message are wanted, the others are skipped without being read.

Generated code never accepts a message that fallback.py would refuse. It may refuse others: it then
raises one of `MISFIT`, and the caller takes the fallback, which corrects or names what is wrong.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

from appliance.ros.payload.arrays import WRITERS, binary_readers, readers
from appliance.ros.payload.cost import cost_of
from appliance.ros.payload.definitions import (
    MAX_INLINE_ITEMS,
    PRIMITIVES,
    Array,
    FieldType,
    ItemType,
    Primitive,
    Selection,
    Sequence,
    Serialization,
    String,
    TypeDescription,
    WideString,
)

# The errors that generated code raises when a message is not exactly as expected.
MISFIT = (
    KeyError,
    IndexError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
    struct.error,
)

_COUNT = PRIMITIVES["uint32"]
_PADDING = Primitive("padding", "x", 1)


class GeneratedConverters(NamedTuple):
    """The functions of a type, and their source.

    `decode_plain` returns arrays as lists. `decode` returns numpy arrays, which orjson writes
    faster and, for float32, with half the digits.
    """

    decode: Callable[[bytes], dict[str, Any]]
    decode_plain: Callable[[bytes], dict[str, Any]]
    encode: Callable[[Any], bytes]
    source: str


class Checker(NamedTuple):
    """The function that checks that a message of a type can be read, and its source.

    It raises OverBudgetError when the message costs more than it may (cost.py).
    """

    check: Callable[[bytes, int], object]
    source: str


class OverBudgetError(Exception):
    """A message costs more than it may."""


class BinaryDecoder(NamedTuple):
    """The function that reads a type for encodings with byte strings, and its source.

    Octets become bytes, and other arrays of numbers `arrays.Numbers`.
    """

    decode: Callable[[bytes], dict[str, Any]]
    source: str


def generate_binary(description: TypeDescription, wanted: Selection | None = None) -> BinaryDecoder:
    """Generates and compiles the binary decoder of a type, or of some of its fields."""
    decoder = _Decoder(description.serialization, wanted, "numbers_{}({})")
    source = decoder.function(description)
    namespace = {**decoder.constants, **binary_readers()}
    exec(compile(source, f"<binary reader of {description.name}>", "exec"), namespace)
    return BinaryDecoder(namespace["decode"], source)


def generate_checker(description: TypeDescription) -> Checker:
    """Generates and compiles the function that checks whether a message is one of the type."""
    decoder = _Decoder(description.serialization, None, has_budget=True)
    source = decoder.function(description)
    namespace = {**decoder.constants, **binary_readers(), "OverBudgetError": OverBudgetError}
    exec(compile(source, f"<checker of {description.name}>", "exec"), namespace)
    return Checker(namespace["decode"], source)


def generate(description: TypeDescription, wanted: Selection | None = None) -> GeneratedConverters:
    """Generates and compiles the converters of a type. With `wanted`, the decoders read only these
    fields."""
    decoder, encoder = (
        _Decoder(description.serialization, wanted),
        _Encoder(description.serialization),
    )
    source = decoder.function(description) + "\n\n" + encoder.function(description)
    code = compile(source, f"<converters of {description.name}>", "exec")
    fast = {**decoder.constants, **readers(with_numpy=True)}
    plain = {**decoder.constants, **readers(with_numpy=False)}
    encoding = {**encoder.constants, **WRITERS}
    for namespace in (fast, plain, encoding):
        exec(code, namespace)
    return GeneratedConverters(fast["decode"], plain["decode"], encoding["encode"], source)


# --- what is known of the position ----------------------------------------------------------------


@dataclass(frozen=True)
class Alignment:
    """What is known of the alignment of a position: it is `rest` modulo `modulus` (8, 4, 2 or 1).

    Nothing is aligned to more than `most`.
    """

    modulus: int
    rest: int
    most: int

    def align(self, size: int) -> Alignment:
        size = min(size, self.most)
        if size > self.modulus:
            return Alignment(size, 0, self.most)
        return self.advance(-self.rest % size)

    def is_aligned(self, size: int) -> bool:
        size = min(size, self.most)
        return self.modulus >= size and self.rest % size == 0

    def advance(self, count: int) -> Alignment:
        return Alignment(self.modulus, (self.rest + count) % self.modulus, self.most)

    def after_unknown(self, modulus: int = 1) -> Alignment:
        """The alignment behind a value of unknown size, which ends at a multiple of `modulus`."""
        return Alignment(modulus, 0, self.most)

    def join(self, other: Alignment) -> Alignment:
        """The alignment that holds for both."""
        modulus = min(self.modulus, other.modulus)
        while self.rest % modulus != other.rest % modulus:
            modulus //= 2
        return Alignment(modulus, self.rest % modulus, self.most)


def _after(type_: FieldType, alignment: Alignment) -> Alignment:
    """The alignment behind a value, given the alignment before it."""
    if isinstance(type_, Primitive):
        return alignment.align(type_.size).advance(type_.size)
    if isinstance(type_, String):
        return alignment.after_unknown()
    if isinstance(type_, WideString):
        return alignment.after_unknown(4)
    if isinstance(type_, TypeDescription):
        for field in type_.fields:
            alignment = _after(field.type, alignment)
        return alignment if type_.fields else alignment.advance(len(type_.serialization.empty))
    if isinstance(type_, Sequence):
        alignment = alignment.align(4).advance(4)
        return alignment.join(_after(type_.item, _loop_alignment(type_.item, alignment)))
    if isinstance(type_.item, Primitive):
        return alignment.align(type_.item.size).advance(type_.item.size * type_.length)
    return _after(type_.item, _loop_alignment(type_.item, alignment))


def _loop_alignment(item: FieldType, alignment: Alignment) -> Alignment:
    """The alignment that holds at the beginning of each iteration over items."""
    alignment = alignment.align(_first_size(item))
    while (joined := alignment.join(_after(item, alignment))) != alignment:
        alignment = joined
    return alignment


def _first_size(type_: FieldType) -> int:
    """The size to which the first number of a value is aligned."""
    if isinstance(type_, Primitive):
        return type_.size
    if isinstance(type_, Array):
        return _first_size(type_.item)
    if isinstance(type_, TypeDescription):
        return _first_size(type_.fields[0].type) if type_.fields else 1
    return 4


def _is_inline_array(type_: FieldType) -> bool:
    """Whether the value is an array that is part of a run. Arrays of float32 are not, as numpy
    writes these with half the digits."""
    return (
        isinstance(type_, Array)
        and isinstance(type_.item, Primitive)
        and (type_.item.is_octet or (type_.length <= MAX_INLINE_ITEMS and type_.item.code != "f"))
    )


def _is_run(type_: FieldType) -> bool:
    """Whether the whole value is part of a run."""
    if isinstance(type_, TypeDescription):
        return all(_is_run(field.type) for field in type_.fields)
    return isinstance(type_, Primitive) or _is_inline_array(type_)


def _run_size(type_: FieldType, rest: int, most: int) -> int:
    """The size of a value that is part of a run, at a position that is `rest` modulo 8."""
    if isinstance(type_, TypeDescription):
        size = 0 if type_.fields else len(type_.serialization.empty)
        for field in type_.fields:
            size += _run_size(field.type, rest + size, most)
        return size
    item, count = (type_.item, type_.length) if isinstance(type_, Array) else (type_, 1)
    assert isinstance(item, Primitive)
    return -rest % min(item.size, most) + count * item.size


# --- the two generators ---------------------------------------------------------------------


class _Part(NamedTuple):
    """A part of a run: `length` numbers, or as many bytes.

    `text` is the names of the variables that are read, or the expression that is written. It is
    empty for padding.
    """

    primitive: Primitive
    length: int
    text: str

    @property
    def code(self) -> str:
        if self.primitive.is_octet and self.length > 1:
            return f"{self.length}s"
        return self.primitive.code * self.length

    @property
    def size(self) -> int:
        return self.primitive.size * self.length


class _Generator:
    """The common base of the decoder and the encoder: lines, names, the run and the position.

    The position is an index into the message with its header. It is the number `_offset`, plus the
    variable `q` once a value of unknown size has been passed, plus `_terms`, expressions that have
    yet to be added to `q`.
    """

    def __init__(self, serialization: Serialization) -> None:
        self.constants: dict[str, Any] = {}
        self._serialization = serialization
        self._lines: list[str] = []
        self._indent = 1
        self._names = 0
        self._run: list[_Part] = []
        self._alignment = Alignment(8, 0, serialization.alignment)
        self._variable = False
        self._offset = len(serialization.header)
        self._terms: list[str] = []

    def _line(self, text: str) -> None:
        self._lines.append("    " * self._indent + text)

    @contextmanager
    def _block(self, head: str) -> Iterator[None]:
        self._line(head)
        self._indent += 1
        yield
        self._indent -= 1

    def _name(self, hint: str) -> str:
        self._names += 1
        return f"{hint}_{self._names}"

    def _settle(self) -> None:
        """Adds lines that set `q` to the position."""
        terms = [*self._terms]
        if self._offset:
            terms.append(str(self._offset))
        if terms:
            self._line(f"q {'+=' if self._variable else '='} {' + '.join(terms)}")
        self._variable, self._offset, self._terms = True, 0, []

    def _position(self) -> str:
        """An expression for the position: `16`, `q`, `q + 8`."""
        if self._terms:
            self._settle()
        if not self._variable:
            return str(self._offset)
        return f"q + {self._offset}" if self._offset else "q"

    def _end_run(self, method: str) -> tuple[str, str]:
        """Defines the constant that reads or writes the run, and advances past the run.

        Returns the name of the constant, and the index expression that selects the layout of a run
        that has several; else an empty string.
        """
        layouts: dict[int, struct.Struct] = {}
        for rest in range(self._alignment.rest, 8, self._alignment.modulus):
            position, codes = rest, "<"
            for part in self._run:
                padding = -position % min(part.primitive.size, self._serialization.alignment)
                codes += "x" * padding + part.code
                position += padding + part.size
            # The index counts the header's four bytes, too; alignment does not.
            layouts[(rest + len(self._serialization.header)) % 8] = struct.Struct(codes)
        for part in self._run:
            self._alignment = self._alignment.align(part.primitive.size).advance(part.size)
        self._run = []
        name = self._name("R")
        first, *others = layouts.values()
        if all(other.format == first.format for other in others):
            self.constants[name] = getattr(first, method)
            self._offset += first.size
            return name, ""
        self._settle()
        unused = struct.Struct("<")
        every = [layouts.get(index, unused) for index in range(8)]
        self.constants[name] = tuple(getattr(layout, method) for layout in every)
        self.constants[f"SIZE_{name}"] = tuple(layout.size for layout in every)
        alignment = self._name("phase")
        self._line(f"{alignment} = q & 7")
        self._terms.append(f"SIZE_{name}[{alignment}]")
        return name, f"[{alignment}]"

    def _fill(self, description: TypeDescription) -> None:
        """Adds the byte of a structure without fields to the run."""
        if not description.fields and self._serialization.empty:
            self._run.append(_Part(_PADDING, 1, ""))

    def _stride(self, item: FieldType) -> int | None:
        """The bytes from one item to the next, if all items have the same layout when the first is
        at the present position; else None."""
        alignment = _loop_alignment(item, self._alignment)
        if not _is_run(item) or _after(item, alignment) != alignment:
            return None
        most = self._serialization.alignment
        sizes = {
            _run_size(item, rest, most) for rest in range(alignment.rest, 8, alignment.modulus)
        }
        return sizes.pop() if len(sizes) == 1 else None


class _Decoder(_Generator):
    """Generates `decode(b)`, which returns the value of the message `b`, or of its wanted fields.

    `inline_array` is the format of the expression for an inline array; its arguments are the name
    of the type and the names of the numbers. With `has_budget` the function is `decode(b, left)`,
    which raises OverBudgetError when the message costs more than `left`.
    """

    def __init__(
        self,
        serialization: Serialization,
        wanted: Selection | None,
        inline_array: str = "[{1}]",
        *,
        has_budget: bool = False,
    ) -> None:
        super().__init__(serialization)
        self._wanted = wanted
        self._inline_array = inline_array
        self._has_budget = has_budget

    def function(self, description: TypeDescription) -> str:
        if self._serialization.header:
            self._line("if b[:2] != LITTLE_ENDIAN: raise ValueError")
        value = self._value(description, "message")
        self._flush()
        self._line(f"return {value}")
        head = "def decode(b, left):" if self._has_budget else "def decode(b):"
        return "\n".join([head, *self._lines, ""])

    def _skip(self, type_: FieldType) -> None:
        """Adds lines that skip a value without reading it."""
        item, count = (type_.item, type_.length) if isinstance(type_, Array) else (type_, 1)
        if isinstance(type_, TypeDescription):
            self._fill(type_)
            for field in type_.fields:
                self._skip(field.type)
        elif isinstance(item, Primitive) and count * item.size <= MAX_INLINE_ITEMS:
            self._run.append(_Part(Primitive("skipped", "x" * item.size, item.size), count, ""))
        elif isinstance(item, Primitive):
            self._flush()
            self._skip_numbers(item, str(count))
        elif isinstance(type_, (String, WideString)):
            size = self._number(_COUNT, "size")
            self._flush()
            self._terms.append(size if isinstance(type_, String) else f"{size} * 4")
            self._alignment = self._alignment.after_unknown(1 if isinstance(type_, String) else 4)
        elif isinstance(type_, Sequence) and isinstance(type_.item, Primitive):
            size = self._number(_COUNT, "size")
            self._flush()
            empty = self._alignment
            self._skip_numbers(type_.item, size)
            self._alignment = self._alignment.join(empty)
        else:
            wanted, self._wanted = self._wanted, {}
            self._value(type_, "skipped")
            self._wanted = wanted

    def _skip_numbers(self, primitive: Primitive, count: str) -> None:
        self._align(primitive.size, count)
        self._terms.append(f"{count} * {primitive.size}")
        self._alignment = _loop_alignment(primitive, self._alignment)

    def _value(self, type_: FieldType, hint: str) -> str:
        """Adds lines that read a value. Returns the expression for it, valid after the next
        flush."""
        if isinstance(type_, Primitive):
            return self._number(type_, hint)
        if isinstance(type_, TypeDescription):
            return self._structure(type_)
        if isinstance(type_, String):
            return self._string(type_, hint)
        if isinstance(type_, WideString):
            return self._wide_string(type_, hint)
        if isinstance(type_, Array):
            return self._array(type_, hint)
        return self._sequence(type_, hint)

    def _structure(self, description: TypeDescription) -> str:
        self._fill(description)
        wanted = self._wanted
        values = []
        for field in description.fields:
            if wanted is not None and field.name not in wanted:
                self._skip(field.type)
                continue
            self._wanted = wanted[field.name] if wanted is not None else None
            values.append(f"{field.name!r}: {self._value(field.type, field.name)}")
        self._wanted = wanted
        return "{" + ", ".join(values) + "}"

    def _number(self, primitive: Primitive, hint: str) -> str:
        name = self._name(hint)
        self._run.append(_Part(primitive, 1, name))
        return name

    def _flush(self) -> None:
        if not self._run:
            return
        names = [part.text for part in self._run if part.text]
        target = ", ".join(names) + (" = " if len(names) > 1 else ", = " if names else "")
        first_size = self._run[0].primitive.size
        if min(first_size, self._serialization.alignment) > self._alignment.modulus:
            # Aligning first is cheaper than several layouts, and often leaves only one behind it.
            self._align(first_size, "1")
        position = self._position()
        name, layout = self._end_run("unpack_from")
        self._line(f"{target}{name}{layout}(b, {'q' if layout else position})")

    def _string(self, string: String, hint: str) -> str:
        size = self._number(_COUNT, f"{hint}_size")
        self._flush()
        if string.bound is not None:
            self._line(f"if {size} > {string.bound + 1}: raise ValueError")
        self._settle()
        name, end = self._name(hint), self._name("end")
        if self._serialization.terminator:
            self._line(f"{end} = q + {size} - 1")
            # Beyond the message this is an IndexError. An empty string without its NUL is accepted:
            # the byte that is checked is then the last of its size, which is 0.
            self._line(f"if b[{end}]: raise ValueError")
        else:
            self._line(f"{end} = q + {size}")
            self._line(f"if {end} > len(b): raise IndexError")
        self._line(f"{name} = b[q:{end}].decode()")
        self._terms.append(size)
        self._alignment = self._alignment.after_unknown()
        return name

    def _wide_string(self, string: WideString, hint: str) -> str:
        count = self._number(_COUNT, f"{hint}_count")
        self._flush()
        if string.bound is not None:
            self._line(f"if {count} > {string.bound}: raise ValueError")
        name = self._name(hint)
        self._line(f"{name} = read_wide_string(b, {self._position()}, {count})")
        self._terms.append(f"{count} * 4")
        self._alignment = self._alignment.after_unknown(4)
        return name

    def _array(self, array: Array, hint: str) -> str:
        item, length = array.item, array.length
        if not isinstance(item, Primitive):
            self._flush()
            return self._loop(item, str(length), hint)
        if item.is_octet:
            name = self._name(hint)
            self._run.append(_Part(item, length, name))
            return f"base64({name})" if length > 1 else f"base64(bytes([{name}]))"
        if _is_inline_array(array):
            names = ", ".join(self._number(item, hint) for _ in range(length))
            return self._inline_array.format(item.name, names)
        self._flush()
        return self._numbers(item, str(length), hint)

    def _sequence(self, sequence: Sequence, hint: str) -> str:
        item = sequence.item
        count = self._number(_COUNT, f"{hint}_count")
        self._flush()
        if sequence.bound is not None:
            self._line(f"if {count} > {sequence.bound}: raise ValueError")
        empty = self._alignment
        if isinstance(item, Primitive):
            value = self._numbers(item, count, hint)
        else:
            value = self._loop(item, count, hint)
        self._alignment = self._alignment.join(empty)
        return value

    def _align(self, size: int, count: str) -> None:
        """Adds lines that skip the padding before items; without items there is no padding."""
        if not self._alignment.is_aligned(size):
            self._settle()
            self._line(f"{'' if count.isdigit() else f'if {count}: '}q += (4 - q) & {size - 1}")
            self._alignment = self._alignment.align(size)

    def _numbers(self, primitive: Primitive, count: str, hint: str) -> str:
        self._align(primitive.size, count)
        name = self._name(hint)
        self._line(f"{name} = read_{primitive.name}(b, {self._position()}, {count})")
        self._terms.append(f"{count} * {primitive.size}")
        self._alignment = _loop_alignment(primitive, self._alignment)
        return name

    def _loop(self, item: ItemType, count: str, hint: str) -> str:
        if self._has_budget:
            self._line(f"left -= {count} * {cost_of(item)}")
            self._line("if left < 0: raise OverBudgetError")
        self._align(_first_size(item), count)
        items = self._name(hint)
        self._settle()
        stride = self._stride(item)
        self._alignment = _loop_alignment(item, self._alignment)
        if stride is not None:
            value = self._value(item, hint)
            names = "".join(f"{part.text}, " for part in self._run if part.text)
            name, _ = self._end_run("iter_unpack")
            end = self._name("end")
            self._line(f"{end} = q + {count} * {stride}")
            self._line(f"if {end} > len(b): raise ValueError")
            self._line(f"{items} = [{value} for ({names}) in {name}(b[q:{end}])]")
            self._line(f"q = {end}")
            self._offset = 0
            return items
        # A false count stops at the end of the message, as every item takes at least a byte.
        self._line(f"{items} = []")
        with self._block(f"for _ in range({count}):"):
            value = self._value(item, hint)
            self._flush()
            self._line(f"{items}.append({value})")
            self._settle()
        return items


class _Encoder(_Generator):
    """Generates `encode(message)`, which returns the serialized message, in little endian."""

    def __init__(self, serialization: Serialization) -> None:
        super().__init__(serialization)
        # The header is the beginning of the first run.
        if serialization.header:
            self._run = [_Part(PRIMITIVES["uint8"], len(serialization.header), "HEADER")]
        self._alignment = self._alignment.advance(-len(serialization.header))
        self._offset = 0
        self._pieces: list[str] = []  # expressions for bytes
        self._spilled = False

    def function(self, description: TypeDescription) -> str:
        self._value(description, "message", "message")
        self._flush()
        if self._spilled:
            self._spill()
            self._line("return join(w)")
        elif len(self._pieces) == 1:
            self._line(f"return {self._pieces[0]}")
        else:
            self._line(f"return join(({', '.join(self._pieces)}))")
        return "\n".join(["def encode(message):", *self._lines, ""])

    def _value(self, type_: FieldType, source: str, hint: str) -> None:
        """Adds lines that check and write the value of the expression `source`."""
        if isinstance(type_, TypeDescription):
            self._structure(type_, source, hint)
        elif isinstance(type_, Primitive):
            name = self._assign(hint, source)
            # struct would write true and false as numbers; there is only one object of each.
            if type_.name == "bool":
                self._line(f"if {name} is not True and {name} is not False: raise TypeError")
            else:
                self._line(f"if {name} is True or {name} is False: raise TypeError")
            self._run.append(_Part(type_, 1, name))
        elif isinstance(type_, String):
            self._string(type_, source, hint)
        elif isinstance(type_, WideString):
            name = self._assign(hint, f"write_wide_string({source})")
            self._bound(f"len({name}) // 4", type_.bound)
            self._run.append(_Part(_COUNT, 1, f"len({name}) // 4"))
            self._bytes(name, self._alignment.after_unknown(4))
        elif isinstance(type_, Array):
            self._array(type_, source, hint)
        else:
            self._sequence(type_, source, hint)

    def _assign(self, hint: str, source: str) -> str:
        name = self._name(hint)
        self._line(f"{name} = {source}")
        return name

    def _bound(self, size: str, bound: int | None) -> None:
        if bound is not None:
            self._line(f"if {size} > {bound}: raise ValueError")

    def _flush(self) -> None:
        if not self._run:
            return
        texts = ", ".join(part.text for part in self._run if part.text)
        if not texts and len(self._run) == 1:
            # A lone NUL, or the byte of an empty structure.
            self._run, self._offset, self._alignment = (
                [],
                self._offset + 1,
                self._alignment.advance(1),
            )
            self._pieces.append("b'\\0'")
            return
        name, layout = self._end_run("pack")
        self._pieces.append(f"{name}{layout}({texts})")

    def _bytes(self, name: str, alignment: Alignment) -> None:
        """Adds bytes behind the run."""
        self._flush()
        self._pieces.append(name)
        self._terms.append(f"len({name})")
        self._alignment = alignment

    def _spill(self) -> None:
        """Adds the pieces so far to the list of the message: a loop begins or ends, or the message
        ends."""
        pieces = ", ".join(self._pieces)
        if not self._spilled:
            self._line(f"w = [{pieces}]")
        elif len(self._pieces) == 1:
            self._line(f"w.append({pieces})")
        elif self._pieces:
            self._line(f"w += ({pieces})")
        self._spilled, self._pieces = True, []

    def _structure(self, description: TypeDescription, source: str, hint: str) -> None:
        name = source if source.isidentifier() else self._assign(hint, source)
        fields = description.fields
        if not fields:
            self._line(f"if {name} != {{}}: raise TypeError")
            self._fill(description)
            return
        # With the right number of fields, and each of them found below, none is unknown or missing.
        self._line(f"if len({name}) != {len(fields)}: raise KeyError")
        for field in fields:
            self._value(field.type, f"{name}[{field.name!r}]", field.name)

    def _string(self, string: String, source: str, hint: str) -> None:
        name = self._assign(hint, f"{source}.encode()")
        if self._serialization.terminator:
            self._line(f"if 0 in {name}: raise ValueError")
        self._bound(f"len({name})", string.bound)
        size = f"len({name}) + 1" if self._serialization.terminator else f"len({name})"
        self._run.append(_Part(_COUNT, 1, size))
        self._bytes(name, self._alignment.after_unknown())
        if self._serialization.terminator:
            self._run.append(_Part(_PADDING, 1, ""))

    def _array(self, array: Array, source: str, hint: str) -> None:
        item, length = array.item, array.length
        if not isinstance(item, Primitive):
            name = self._list(hint, source)
            self._line(f"if len({name}) != {length}: raise ValueError")
            self._flush()
            self._loop(item, name)
        elif item.is_octet:
            name = self._assign(hint, f"octets({source})")
            self._line(f"if len({name}) != {length}: raise ValueError")
            self._run.append(_Part(item, length, name if length > 1 else f"{name}[0]"))
        elif _is_inline_array(array):
            name = self._assign(hint, source)
            self._line(f"if {name}.__class__ is not list: {name} = listed({name})")
            self._line(f"if len({name}) != {length}: raise ValueError")
            self._line(
                f"if not {_python_types(item)}.issuperset(map(type, {name})): raise TypeError"
            )
            self._run.append(_Part(item, length, f"*{name}"))
        else:
            name = self._assign(hint, f"write_{item.name}({source})")
            self._line(f"if len({name}) != {length * item.size}: raise ValueError")
            self._flush()
            self._numbers(item, name)

    def _sequence(self, sequence: Sequence, source: str, hint: str) -> None:
        item = sequence.item
        if isinstance(item, Primitive):
            write = "octets" if item.is_octet else f"write_{item.name}"
            name = self._assign(hint, f"{write}({source})")
            count = f"len({name}) // {item.size}" if item.size > 1 else f"len({name})"
        else:
            name = self._list(hint, source)
            count = f"len({name})"
        self._bound(count, sequence.bound)
        self._run.append(_Part(_COUNT, 1, count))
        self._flush()
        empty = self._alignment
        if isinstance(item, Primitive):
            self._numbers(item, name)
        else:
            self._loop(item, name)
        self._alignment = self._alignment.join(empty)

    def _list(self, hint: str, source: str) -> str:
        name = self._assign(hint, source)
        self._line(f"if {name}.__class__ is not list: raise TypeError")
        return name

    def _align(self, size: int, items: str) -> None:
        """Adds lines that write the padding before items; without items there is no padding."""
        if not self._alignment.is_aligned(size):
            self._settle()
            padding = self._assign("padding", f"ZEROS[:(4 - q) & {size - 1}] if {items} else b''")
            self._bytes(padding, self._alignment.align(size))

    def _numbers(self, primitive: Primitive, name: str) -> None:
        self._align(primitive.size, name)
        self._bytes(name, _loop_alignment(primitive, self._alignment))

    def _loop(self, item: ItemType, items: str) -> None:
        self._align(_first_size(item), items)
        self._spill()
        stride = self._stride(item)
        self._alignment = _loop_alignment(item, self._alignment)
        self._settle()
        element = self._name("item")
        with self._block(f"for {element} in {items}:"):
            self._value(item, element, "item")
            self._flush()
            self._spill()
            if stride is None:
                self._settle()
        if stride is not None:
            self._offset = 0
            self._terms.append(f"len({items}) * {stride}")


def _python_types(primitive: Primitive) -> str:
    """The name of the constant with the Python types that a primitive accepts."""
    return "BOOLS" if primitive.name == "bool" else "NUMBERS" if primitive.is_float else "INTEGERS"
