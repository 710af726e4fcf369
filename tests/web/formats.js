// node formats.js URL-of-the-console's-formats.js

import assert from 'node:assert/strict'

const { decode, preview, LEAVES } = await import(process.argv[2])
const bytes = (text) => new TextEncoder().encode(text)
const json = { contentType: 'application/json' }
const cbor = { contentType: 'application/cbor' }
const hex = (text) => Uint8Array.from(Buffer.from(text.replaceAll(' ', ''), 'hex'))

// Exact numbers, keys of the prototype, escapes.
let told = await decode(bytes('{"__proto__": {"polluted": 1}, "big": 9007199254740993, "a.b": [1, {"\\u0061": "}\\""}], "e": {}, "n": null}'), json)
assert.equal(told.kind, 'json')
assert.deepEqual(told.leaves.map(([path, text]) => [path, text]), [
  ['__proto__.polluted', '1'], ['big', '9007199254740993'], ['a.b[0]', '1'], ['a.b[1].a', '"}\\""'],
  ['e', '{}'], ['n', 'null'],
])
assert.equal({}.polluted, undefined)
told = await decode(bytes('[true, -0.5e3, "x"]'), {})
assert.deepEqual(told.leaves, [['[0]', 'true', 1], ['[1]', '-0.5e3', -500], ['[2]', '"x"', null]])
assert.deepEqual((await decode(bytes('[]'), json)).leaves, [['', '[]', null]])

// Deep, long and large.
const deep = '['.repeat(200000) + ']'.repeat(200000)
assert.match((await decode(bytes(deep), json)).note, /nested deeper|not shown/)
told = await decode(bytes(`[${'1,'.repeat(3000000)}1]`), json)
assert.equal(told.leaves.length, LEAVES)
told = await decode(bytes(JSON.stringify({ text: 'x'.repeat(10_000_000) })), json)
assert.ok(told.leaves[0][1].length < 3000)
told = await decode(new Uint8Array(10_000_000), {})
assert.ok(told.kind === 'hex' && told.text.length < 40000)
assert.ok(preview(new Uint8Array(10_000_000), {}).length < 200)

// Neither JSON nor UTF-8.
assert.equal((await decode(bytes('{"a": '), json)).kind, 'text')
assert.equal((await decode(hex('fffe00'), { contentType: 'text/plain' })).kind, 'hex')
assert.equal((await decode(bytes('<img src=x>'), { contentType: 'image/svg+xml' })).kind, 'hex')

// CBOR: 64 bits, typed arrays, keys of the prototype, what is not allowed.
told = await decode(hex('a3 69 5f5f70726f746f5f5f a1 61 61 01  62 6269 1b 0020000000000001  61 74 d8 56 50 000000000000f03f 0000000000000040'), cbor)
assert.deepEqual(told.leaves.map(([path, text]) => [path, text]), [
  ['__proto__.a', '1'], ['bi', '9007199254740993'], ['t[0]', '1'], ['t[1]', '2'],
])
assert.equal({}.a, undefined)
assert.equal((await decode(hex('d8 ff 00'), cbor)).kind, 'hex')
assert.equal((await decode(hex('9b ffffffffffffffff'), cbor)).kind, 'hex')
assert.equal((await decode(new Uint8Array(300000).fill(0x81), cbor)).kind, 'hex')

// zstd: what is inside is shown as its type; a bomb is not unpacked; rubbish is told.
const zstd = { contentType: 'application/json', userProperties: { 'content-encoding': 'zstd' } }
const rle = (count) => { // blocks of 128 KiB of one byte
  const blocks = []
  for (let each = 0; each < count; each++) blocks.push('%', each === count - 1 ? '03001020' : '02001020')
  return hex(`28b52ffd 0058 ${blocks.filter((part) => part !== '%').join('')}`)
}
told = await decode(hex('28b52ffd 2003 190000 5b315d'), zstd)
assert.deepEqual(told.leaves, [['[0]', '1', 1]])
assert.match(told.note, /^zstd/)
told = await decode(rle(1000), zstd)
assert.ok(told.kind === 'hex' && /more than|not shown/.test(told.note), told.note)
assert.equal((await decode(hex('28b52ffd 00'), zstd)).kind, 'hex')
console.log('ok')
