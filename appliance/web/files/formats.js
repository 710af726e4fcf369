// What a payload says, as plain text: never markup, never an object with the payload's own keys.
// Runs in the worker. All sizes are bounded; what is longer is cut, and says so.

import { checkedPicture, pictureType } from './pictures.js'

export const LEAVES = 1000 // values of one message that are shown
const DEPTH = 64
const TEXT = 64 * 1024 // characters of a text
const VALUE = 2000 // characters of one value
const PATH = 500 // characters of where it is
const HEX = 4096 // bytes of a hex dump
const INFLATED = 10 * 1024 * 1024 // bytes that a compressed payload may have

let cbor = null
let zstd = null

export async function loadCbor() {
  cbor ??= (await import('./vendor/cborg/lib/decode.js')).decode
  return cbor
}

async function loadZstd() {
  zstd ??= (await import('./vendor/fzstd.mjs')).Decompress
  return zstd
}

export function contentType(properties) {
  return (properties.contentType ?? '').split(';')[0].trim().toLowerCase()
}

export function isZstd(properties) {
  const found = properties.userProperties?.['content-encoding']
  return found === 'zstd'
}

/** One line about a payload, for a list. */
export function preview(payload, properties) {
  if (payload.length === 0) return '(empty)'
  const type = contentType(properties)
  if (isZstd(properties)) return `zstd, ${size(payload.length)}`
  if (type === 'application/cbor') {
    if (cbor === null) loadCbor().catch(() => {})
    if (cbor !== null && payload.length <= 4096) {
      try {
        const { leaves } = leavesOfCbor(payload)
        return cut(leaves.map(([path, text]) => (path ? `${path} ${text}` : text)).join(', '), 160)
      } catch {
        return `not valid CBOR, ${size(payload.length)}`
      }
    }
    return `CBOR, ${size(payload.length)}`
  }
  if (type.startsWith('image/') || pictureType(payload)) return `picture, ${size(payload.length)}`
  const head = payload.subarray(0, 480)
  if (type === '' || type.startsWith('text/') || type.endsWith('json')) {
    const text = new TextDecoder().decode(head)
    if (isPlain(text.slice(0, -1))) return cut(text.replace(/\s+/g, ' '), 160)
  }
  return `${hexOf(head.subarray(0, 16))}${payload.length > 16 ? ` … ${size(payload.length)}` : ''}`
}

/**
 * A payload for the inspector: kind, note, and what the kind has of leaves, text and picture.
 * A leaf is [path, text, number or null].
 */
export async function decode(payload, properties) {
  let bytes = payload
  let note = ''
  if (isZstd(properties)) {
    try {
      bytes = await inflate(payload)
      note = `zstd, ${size(payload.length)}; `
    } catch (error) {
      return { kind: 'hex', note: `not shown unpacked: ${error.message}`, text: hexDump(payload) }
    }
  }
  const shown = await show(bytes, contentType(properties))
  shown.note = note + shown.note
  return shown
}

async function show(bytes, type) {
  if (bytes.length === 0) return { kind: 'text', note: 'empty', text: '' }
  if (pictureType(bytes)) {
    try {
      return { kind: 'image', note: type, picture: checkedPicture(bytes) }
    } catch (error) {
      return { kind: 'hex', note: error.message, text: hexDump(bytes) }
    }
  }
  if (type === 'application/cbor') {
    try {
      await loadCbor()
      return { kind: 'cbor', ...leavesOfCbor(bytes) }
    } catch (error) {
      return { kind: 'hex', note: `not shown as CBOR: ${error.message}`, text: hexDump(bytes) }
    }
  }
  const known = type === '' || type.startsWith('text/') || type.endsWith('json')
  let text
  try {
    text = known ? new TextDecoder('utf-8', { fatal: true }).decode(bytes) : null
  } catch {
    return { kind: 'hex', note: 'not valid UTF-8', text: hexDump(bytes) }
  }
  if (text === null || !isPlain(text.slice(0, 1000))) {
    return { kind: 'hex', note: type, text: hexDump(bytes) }
  }
  if (!type.startsWith('text/')) {
    try {
      JSON.parse(text)
      return { kind: 'json', ...leavesOfJson(text) }
    } catch (error) {
      if (type) return { kind: 'text', note: `not shown as JSON: ${error.message}`, text: cut(text, TEXT) }
    }
  }
  return { kind: 'text', note: type, text: cut(text, TEXT) }
}

/** The values of a valid JSON text. Numbers keep their own digits, so that 2^53 + 1 is exact. */
export function leavesOfJson(text) {
  const token = /[\s,:]*([{}[\]]|"[^"\\]*(?:\\.[^"\\]*)*"|[^\s,:{}[\]"]+)/gy
  const leaves = []
  const stack = []
  let note = ''
  const here = () => {
    let path = ''
    for (const level of stack) {
      path += level.isArray ? `[${level.count}]` : `${path ? '.' : ''}${level.key}`
      if (path.length > PATH) break
    }
    return cut(path, PATH)
  }
  const add = (value) => {
    leaves.push([here(), cut(value, VALUE), value[0] === '"' ? null : number(value)])
  }
  for (let match = token.exec(text); match !== null; match = token.exec(text)) {
    const word = match[1]
    const top = stack.at(-1)
    if (word === ']' || word === '}') {
      stack.pop()
      if (!top.any) add(top.isArray ? '[]' : '{}')
      next(stack.at(-1))
    } else if (top && !top.isArray && top.key === null) {
      top.key = cut(String(JSON.parse(word)), 200)
      top.any = true
    } else {
      if (top) top.any = true
      if (word === '[' || word === '{') {
        if (stack.length >= DEPTH) {
          note = `nested deeper than ${DEPTH} levels`
          break
        }
        stack.push({ isArray: word === '[', key: null, count: 0, any: false })
      } else {
        add(word)
        next(top)
      }
    }
    if (leaves.length >= LEAVES) {
      note = `the first ${LEAVES} values`
      break
    }
  }
  return { leaves, note }
}

function next(level) {
  if (!level) return
  level.key = null
  level.count += 1
}

const ARRAYS = {
  64: [1, 'getUint8'], 68: [1, 'getUint8'], 72: [1, 'getInt8'],
  65: [2, 'getUint16', false], 69: [2, 'getUint16', true],
  66: [4, 'getUint32', false], 70: [4, 'getUint32', true],
  67: [8, 'getBigUint64', false], 71: [8, 'getBigUint64', true],
  73: [2, 'getInt16', false], 77: [2, 'getInt16', true],
  74: [4, 'getInt32', false], 78: [4, 'getInt32', true],
  75: [8, 'getBigInt64', false], 79: [8, 'getBigInt64', true],
  81: [4, 'getFloat32', false], 85: [4, 'getFloat32', true],
  82: [8, 'getFloat64', false], 86: [8, 'getFloat64', true],
}

function typedArray([width, read, little], limit) {
  return (inner) => {
    const bytes = inner()
    if (!(bytes instanceof Uint8Array)) throw new Error('a typed array is not a byte string')
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength)
    const count = Math.min(Math.floor(bytes.length / width), limit)
    return Array.from({ length: count }, (_, index) => view[read](index * width, little))
  }
}

/** How CBOR's typed arrays (RFC 8746) are read, each with so many values at most. */
export function arrayTags(limit) {
  return Object.fromEntries(Object.entries(ARRAYS).map(([tag, kind]) => [tag, typedArray(kind, limit)]))
}

const TAGS = arrayTags(LEAVES + 1)

function leavesOfCbor(bytes) {
  const whole = cbor(bytes, { useMaps: true, tags: TAGS })
  const leaves = []
  let note = ''
  const waiting = [['', whole, 0]]
  while (waiting.length) {
    const [path, value, depth] = waiting.pop()
    const isArray = Array.isArray(value)
    if (!isArray && !(value instanceof Map)) {
      leaves.push([path, cut(scalar(value), VALUE), typeof value === 'number' ? value : number(value)])
    } else if ((isArray ? value.length : value.size) === 0) {
      leaves.push([path, isArray ? '[]' : '{}', null])
    } else if (depth >= DEPTH) {
      note = `nested deeper than ${DEPTH} levels`
    } else {
      const some = []
      for (const [key, inner] of value.entries()) {
        if (some.length > LEAVES) break
        const name = cut(String(key), 200)
        const inside = isArray ? `${path}[${name}]` : `${path}${path ? '.' : ''}${name}`
        some.push([path.length > PATH ? path : cut(inside, PATH), inner, depth + 1])
      }
      waiting.push(...some.reverse())
    }
    if (leaves.length >= LEAVES) {
      note = `the first ${LEAVES} values`
      break
    }
  }
  return { leaves, note }
}

function scalar(value) {
  if (typeof value === 'string') return JSON.stringify(cut(value, VALUE))
  if (value instanceof Uint8Array) return `${size(value.length)}: ${hexOf(value.subarray(0, 64))}`
  return Object.is(value, -0) ? '-0' : String(value)
}

function number(value) {
  if (typeof value !== 'string' && typeof value !== 'bigint') return null
  const found = value === 'true' ? 1 : value === 'false' ? 0 : value === 'null' ? NaN : Number(value)
  return Number.isFinite(found) ? found : null
}

/** What is in a compressed payload. Raises an Error when it is more than `limit` bytes. */
export async function inflate(payload, limit = INFLATED) {
  const Decompress = await loadZstd()
  const parts = []
  let length = 0
  const stream = new Decompress((part) => {
    length += part.length
    if (length > limit) throw new Error(`it is more than ${size(limit)}`)
    parts.push(part)
  })
  for (let at = 0; at < payload.length; at += 16384) {
    stream.push(payload.slice(at, at + 16384), at + 16384 >= payload.length)
  }
  const whole = new Uint8Array(length)
  let at = 0
  for (const part of parts) {
    whole.set(part, at)
    at += part.length
  }
  return whole
}

/** Whether it is text to read: no control characters but white space, no replacement character. */
function isPlain(text) {
  // eslint-disable-next-line no-control-regex
  return !/[\x00-\x08\x0e-\x1f\x7f\ufffd]/.test(text)
}

export function cut(text, length) {
  return text.length > length ? `${text.slice(0, length)}…` : text
}

/** A name or a line as it can be shown: short, and what is invisible or turns text round is not. */
export function shown(name, length = 120) {
  if (name === '') return '(empty)'
  // eslint-disable-next-line no-control-regex
  return cut(name, length).replace(/[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]/g, '·')
}

/** A number of things: `one` is the word for one of them. */
export function counted(number, one) {
  return `${number} ${one}${number === 1 ? '' : 's'}`
}

export function size(bytes) {
  if (bytes < 1024) return `${bytes} B`
  return bytes < 1048576 ? `${(bytes / 1024).toFixed(1)} KiB` : `${(bytes / 1048576).toFixed(1)} MiB`
}

export function hexOf(bytes) {
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, '0')).join(' ')
}

function hexDump(bytes) {
  const lines = []
  for (let at = 0; at < Math.min(bytes.length, HEX); at += 16) {
    const row = bytes.subarray(at, at + 16)
    const text = Array.from(row, (byte) => (byte > 31 && byte < 127 ? String.fromCharCode(byte) : '.')).join('')
    lines.push(`${at.toString(16).padStart(6, '0')}  ${hexOf(row).padEnd(47)}  ${text}`)
  }
  if (bytes.length > HEX) lines.push(`… ${size(bytes.length)} in all`)
  return lines.join('\n')
}
