// The fields of a message, from JSON or CBOR, packed or not. What comes is a stranger's: fields are
// read one by one, and a name from a payload never becomes one of an object here.

import { arrayTags, contentType, inflate, isZstd, loadCbor } from './formats.js'

export const UNPACKED = 64 * 1024 * 1024 // bytes; a map of 4000 × 4000 has 48 MB as JSON
export const NUMBERS = 200000 // of a typed array of numbers; one of bytes comes whole

const TAGS = { ...arrayTags(NUMBERS), 64: bytesOf, 68: bytesOf, 72: signed }

/** The bytes of a payload, unpacked. Raises an Error. */
export async function unpacked(payload, properties) {
  return isZstd(properties) ? inflate(payload, UNPACKED) : payload
}

/** A message for `field`. Raises an Error that says what is wrong. */
export async function valueOf(payload, properties) {
  const bytes = await unpacked(payload, properties)
  const type = contentType(properties)
  if (type === 'application/cbor') {
    const decode = await loadCbor()
    return decode(bytes, { useMaps: true, tags: TAGS })
  }
  if (type && !type.endsWith('json')) throw new Error(`it comes as ${type}, and not as JSON or CBOR`)
  return JSON.parse(new TextDecoder('utf-8', { fatal: true }).decode(bytes))
}

/** What is at a path of field names; undefined where nothing is. */
export function field(value, ...path) {
  let found = value
  for (const name of path) {
    if (found instanceof Map) found = found.get(name)
    else if (found !== null && typeof found === 'object' && Object.hasOwn(found, name)) found = found[name]
    else return undefined
  }
  return found
}

/** A number; NaN for null, which stands for what JSON cannot say, and for what is no number. */
export function numberAt(value, ...path) {
  const found = field(value, ...path)
  return typeof found === 'number' || typeof found === 'bigint' ? Number(found) : NaN
}

/** A short text, empty where there is none. */
export function textAt(value, ...path) {
  const found = field(value, ...path)
  return typeof found === 'string' ? found.slice(0, 200) : ''
}

function bytesOf(inner) {
  const bytes = inner()
  if (!(bytes instanceof Uint8Array)) throw new Error('a typed array is not a byte string')
  return bytes
}

function signed(inner) {
  const bytes = bytesOf(inner)
  return new Int8Array(bytes.buffer, bytes.byteOffset, bytes.length)
}
