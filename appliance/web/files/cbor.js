// A message as CBOR (RFC 8949), from JSON that lost nothing (exact.js) and the schema of its type:
// bytes become byte strings, and arrays of numbers typed arrays (RFC 8746), as the bridge writes them.
// Integers keep all their digits. Of a value that no schema describes its own form decides.

import { Num } from './exact.js'
import { describe } from './schema.js'

const SHARE = 64 * 1024 // bytes that room is made for at first
const BITS = 2n ** 64n // an integer of CBOR is below this; beyond it needs a tag, which the bridge refuses
const [UNSIGNED, NEGATIVE, BYTES, TEXT, ARRAY, MAP, TAG] = [0, 1, 2, 3, 4, 5, 6]
const FALSE = 0xf4
const TRUE = 0xf5
const NULL = 0xf6
const FLOAT64 = 0xfb
const INTEGER = /^-?\d{1,25}$/

// Typed arrays in little endian: tag, bytes of a number, and DataView's method, by the range of a number.
const INTEGERS = new Map([
  ['-128 127', [72, 1, 'setInt8']],
  ['-32768 32767', [77, 2, 'setInt16']], ['0 65535', [69, 2, 'setUint16']],
  ['-2147483648 2147483647', [78, 4, 'setInt32']], ['0 4294967295', [70, 4, 'setUint32']],
  [`${-BITS / 2n} ${BITS / 2n - 1n}`, [79, 8, 'setBigInt64']], [`0 ${BITS - 1n}`, [71, 8, 'setBigUint64']],
])
const FLOATS = [86, 8, 'setFloat64'] // the schema does not tell a float32, and the bridge takes both

/**
 * The bytes of a value that `parse` has read, and that `check` finds right; `root` is its schema, null without one.
 * Throws an Error for what CBOR cannot carry.
 */
export function encode(root, value) {
  const output = new Output()
  write(output, root, root, value)
  return output.bytes.slice(0, output.length)
}

function write(output, root, part, value) {
  const wanted = root === null ? { kind: 'any' } : describe(root, part)
  if (value instanceof Num) number(output, wanted, value.text)
  else if (value instanceof Map) object(output, root, wanted, value)
  else if (Array.isArray(value)) array(output, root, wanted, value)
  else if (typeof value !== 'string') output.octet(value === null ? NULL : value ? TRUE : FALSE)
  else if (wanted.kind === 'octets') output.string(BYTES, Uint8Array.from(atob(value), (char) => char.charCodeAt(0)))
  else text(output, value)
}

function number(output, { kind }, digits) {
  if (kind === 'number' || !INTEGER.test(digits)) {
    output.octet(FLOAT64)
    output.number(8, 'setFloat64', Number(digits), false)
    return
  }
  const found = BigInt(digits)
  if (found >= BITS || found < -BITS) throw new Error(`${digits} does not fit in an integer of 64 bits.`)
  output.head(found < 0n ? NEGATIVE : UNSIGNED, found < 0n ? -1n - found : found)
}

function text(output, value) {
  if (/\p{Surrogate}/u.test(value)) throw new Error('A text has half of a character of UTF-16, which CBOR cannot carry.')
  output.string(TEXT, new TextEncoder().encode(value))
}

function object(output, root, { fields }, value) {
  output.head(MAP, value.size)
  for (const [name, inner] of value) {
    text(output, name)
    write(output, fields ? root : null, fields?.get(name), inner)
  }
}

function array(output, root, wanted, value) {
  if (wanted.kind === 'octets') return output.string(BYTES, Uint8Array.from(value, ({ text: digits }) => Number(digits)))
  const typed = wanted.kind === 'array' && typedArray(describe(root, wanted.item))
  if (typed) return numbers(output, typed, value)
  output.head(ARRAY, value.length)
  for (const item of value) write(output, wanted.kind === 'array' ? root : null, wanted.item, item)
  return undefined
}

function typedArray({ kind, low, high }) {
  return kind === 'number' ? FLOATS : kind === 'integer' && INTEGERS.get(`${low} ${high}`)
}

function numbers(output, [tag, bytes, method], value) {
  output.head(TAG, tag)
  output.head(BYTES, value.length * bytes)
  const convert = method.includes('Big') ? BigInt : Number
  for (const item of value) output.number(bytes, method, item === null ? NaN : convert(item.text), true)
}

/** Bytes that grow. */
class Output {
  constructor() {
    this.length = 0
    this.bytes = new Uint8Array(SHARE)
  }

  /** Where so many more bytes belong. */
  room(count) {
    const at = this.length
    this.length += count
    if (this.length > this.bytes.length) {
      const before = this.bytes
      this.bytes = new Uint8Array(2 * this.length)
      this.bytes.set(before)
    }
    return at
  }

  octet(value) {
    this.bytes[this.room(1)] = value
  }

  number(bytes, method, value, isLittle) {
    const at = this.room(bytes)
    new DataView(this.bytes.buffer)[method](at, value, isLittle)
  }

  /** What every item begins with: its major type, and a number in the fewest bytes. */
  head(major, value) {
    const argument = BigInt(value)
    const type = major << 5
    if (argument < 24n) return this.octet(type | Number(argument))
    const size = [8n, 16n, 32n, 64n].findIndex((bits) => argument < 2n ** bits)
    this.octet(type | (24 + size))
    const method = ['setUint8', 'setUint16', 'setUint32', 'setBigUint64'][size]
    return this.number(1 << size, method, size === 3 ? argument : Number(argument), false)
  }

  string(major, bytes) {
    this.head(major, bytes.length)
    const at = this.room(bytes.length)
    this.bytes.set(bytes, at)
  }
}
