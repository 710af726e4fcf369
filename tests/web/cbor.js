// node cbor.js URL-of-the-console's-files: messages as CBOR, read back with cborg and by their bytes.

import assert from 'node:assert/strict'

const files = process.argv[2]
const { parse } = await import(`${files}/exact.js`)
const { schemaOf } = await import(`${files}/schema.js`)
const { encode } = await import(`${files}/cbor.js`)
const { decode } = await import(`${files}/vendor/cborg/lib/decode.js`)

const hex = (bytes) => Buffer.from(bytes).toString('hex')
const sent = (text, root = null) => hex(encode(root, parse(text)))

// RFC 8949, appendix A: the shortest head, and integers of 64 bits with all digits.
for (const [text, bytes] of [['0', '00'], ['23', '17'], ['24', '1818'], ['255', '18ff'], ['256', '190100'], ['65536', '1a00010000'],
  ['4294967296', '1b0000000100000000'], ['9007199254740993', '1b0020000000000001'], ['18446744073709551615', '1bffffffffffffffff'],
  ['-1', '20'], ['-1000', '3903e7'], ['-9007199254740993', '3b0020000000000000'], ['-18446744073709551616', '3bffffffffffffffff'],
  ['1.1', 'fb3ff199999999999a'], ['1e300', 'fb7e37e43c8800759c'], ['-0.0', 'fb8000000000000000'], ['true', 'f5'], ['false', 'f4'],
  ['null', 'f6'], ['"a"', '6161'], ['"\\u00fc\\ud83d\\ude00"', '66c3bcf09f9880'], ['[1, [2]]', '82018102'],
  ['{"a": 1, "__proto__": {}}', `a261610169${hex(Buffer.from('__proto__'))}a0`]]) {
  assert.equal(sent(text), bytes, text)
}
for (const text of ['18446744073709551616', '-18446744073709551617']) assert.throws(() => sent(text), /64 bits/)
for (const text of ['"\\ud800"', '{"\\udc00": 1}']) assert.throws(() => sent(text), /half of a character/)

// By a schema: floats as floats, bytes as byte strings, arrays of numbers as typed arrays.
const range = (low, high) => ({ type: 'integer', minimum: `@${low}@`, maximum: `@${high}@` })
const list = (items) => ({ type: 'array', items })
const root = schemaOf(JSON.stringify({
  type: 'object',
  properties: {
    x: { type: ['number', 'null'] }, n: range(0, 255), bytes: { anyOf: [{ type: 'string', contentEncoding: 'base64' }, list(range(0, 255))] },
    floats: list({ type: ['number', 'null'] }), int8: list(range(-128, 127)), uint16: list(range(0, 65535)), int16: list(range(-32768, 32767)),
    uint32: list(range(0, 4294967295)), int32: list(range(-2147483648, 2147483647)), int64: list(range('-9223372036854775808', '9223372036854775807')),
    uint64: list(range(0, '18446744073709551615')), odd: list(range(0, 10)), texts: list({ type: 'string' }), flags: list({ type: 'boolean' }),
    parts: list({ $ref: '#' }), stamp: { anyOf: [{ type: 'object', properties: {} }, { const: 'now' }] },
  },
}).replace(/"@|@"/g, ''))
for (const [text, bytes] of [['"x": 2', 'fb4000000000000000'], ['"x": 9007199254740993', 'fb4340000000000000'], ['"n": 2', '02'],
  ['"bytes": "AP8="', '4200ff'], ['"bytes": [0, 255]', '4200ff'], ['"bytes": ""', '40'], ['"floats": []', 'd85640'],
  ['"floats": [1, null]', 'd85650000000000000f03f000000000000f87f'], ['"int8": [-128, 127]', 'd84842807f'], ['"uint16": [1]', 'd845420100'],
  ['"int16": [-2]', 'd84d42feff'], ['"uint32": [4294967295]', 'd84644ffffffff'], ['"int32": [-1]', 'd84e44ffffffff'],
  ['"int64": [9007199254740993, -1]', 'd84f500100000000002000ffffffffffffffff'], ['"uint64": [18446744073709551615]', 'd84748ffffffffffffffff'],
  ['"odd": [1]', '8101'], ['"texts": ["AP8="]', '8164' + hex(Buffer.from('AP8='))], ['"flags": [true]', '81f5'],
  ['"parts": [{"n": 1}]', '81a1616e01'], ['"stamp": "now"', '636e6f77']]) {
  const name = text.slice(1, text.indexOf('"', 1))
  assert.equal(sent(`{${text}}`, root), `a1${hex([0x60 + name.length])}${hex(Buffer.from(name))}${bytes}`, text)
}

// Much, and deep: whole, in a moment.
const begun = performance.now()
const many = `[${'9007199254740993, '.repeat(19000)}1]`
assert.equal(decode(encode(null, parse(many)), { allowBigInt: true }).length, 19001)
assert.equal(decode(encode(null, parse(`"${'ü'.repeat(1e6)}"`))), 'ü'.repeat(1e6))
encode(null, parse('['.repeat(60) + ']'.repeat(60)))
const cyclic = schemaOf('{"type": "array", "items": {"$ref": "#"}}')
assert.equal(sent('[[[]]]', cyclic), '818180')
for (const text of ['{"$ref": "#"}', '{"type": "array"}', '{"type": "array", "items": 5}', '{"type": "object", "properties": {"a": 5}}']) {
  for (const value of ['[1, "a"]', '{"a": [1]}', '"a"', 'null']) encode(schemaOf(text), parse(value))
}
assert.ok(performance.now() - begun < 20000)
console.log('ok')
