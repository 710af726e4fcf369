// node calls.js URL-of-the-console's-files: JSON as text, and what an open page keeps.

import assert from 'node:assert/strict'

const { faultOf, indented, valueOf } = await import(`${process.argv[2]}/json-text.js`)
const { Shelf, covers } = await import(`${process.argv[2]}/shelf.js`)
const bytes = (text) => new TextEncoder().encode(text)

// Digits and texts stay as they are.
assert.equal(indented('{"a":9007199254740993,"b":[1,2],"c":{},"d":[{"e":"}, \\"["}],"f":[]}'), `{
  "a": 9007199254740993,
  "b": [1, 2],
  "c": {},
  "d": [
    {
      "e": "}, \\"["
    }
  ],
  "f": []
}`)
for (const text of ['plain, text', '"a string"', '', '12']) assert.equal(indented(text), text)
// What is no JSON, too deep, or too much to be read stays as it came.
const ones = `[${'1,'.repeat(25000)}1]`
for (const text of ['[', '}}}', '["no end', '{"a":', '[1,,]', '['.repeat(30000) + ']'.repeat(30000), ones]) assert.equal(indented(text), text)
const deep = `${'['.repeat(60)}${'{},'.repeat(9000)}0${']'.repeat(60)}`
assert.match(indented(deep), /cut: 27121 characters in all$/)
assert.ok(indented(deep).length < 70000)
assert.match(indented(`["${'x'.repeat(3_000_000)}"]`), /cut: 3000004 characters in all$/)
assert.equal(faultOf('{"a": tru}'), 'Not JSON: line 1, column 7: a value is expected')
assert.equal(faultOf('[1]'), '')
assert.equal(valueOf('{'), undefined)

// What is kept: the newest, of so many topics.
class Client {
  constructor() {
    this.connected = true
    this.handlers = {}
    this.subscribed = []
  }

  on(name, handler) { this.handlers[name] = handler }

  subscribe(filter, options, done) {
    this.subscribed.push(filter)
    done(null, [], { granted: [filter.startsWith('no/') ? 0x87 : 0] })
  }

  unsubscribe(filters) { this.subscribed = this.subscribed.filter((each) => !filters.includes(each)) }

  send(topic, text, properties = { contentType: 'application/json' }) {
    this.handlers.message(topic, Buffer.from(text), { properties })
  }
}
const client = new Client()
const shelf = new Shelf(client)
const told = async () => Object.fromEntries((await shelf.told()).changes)
client.send('a/b', '1')
assert.deepEqual(await told(), {})
shelf.look({ run: 1, wanted: [['a/+', 10], ['no/#', 1]] })
assert.deepEqual((await shelf.told()).refused, ['no/#'])
client.send('a/b', '1')
client.send('a/b', '9007199254740993')
client.send('a/b/c', '1')
const { 'a/b': kept, ...others } = await told()
assert.deepEqual([kept.text, kept.isJson, kept.size, others], ['9007199254740993', true, 16, {}])
assert.deepEqual(await told(), {})
client.send('a/b', '')
assert.deepEqual(await told(), { 'a/b': null })
client.send('a/cbor', Uint8Array.of(0xa1, 0x61, 0x78, 0x01), { contentType: 'application/cbor' })
client.send('a/zstd', '1', { userProperties: { 'content-encoding': 'zstd' } })
const odd = await told()
assert.deepEqual([odd['a/cbor'].text, odd['a/cbor'].isJson, odd['a/zstd'].text], ['x: 1', false, 'zstd, 1 B'])
for (let index = 0; index < 5000; index++) client.send(`a/${index}`, '1')
assert.equal(shelf.topics.size, 1000)
for (let index = 0; index < 20; index++) client.send(`a/large${index}`, `"${'x'.repeat(1 << 20)}"`)
assert.ok(shelf.bytes <= 8 << 20)
assert.equal(shelf.bytes, [...shelf.topics.values()].reduce((sum, { payload }) => sum + payload.length, 0))

// What comes in a later run while an earlier one is told is told in the later one, all of it.
shelf.look({ run: 2, wanted: [['a/+', 10]] })
for (const topic of ['a/1', 'a/2', 'a/3']) client.send(topic, '1')
const earlier = shelf.told()
shelf.look({ run: 3, wanted: [['a/+', 10]] })
for (const topic of ['a/1', 'a/2', 'a/3']) client.send(topic, '2')
assert.deepEqual([(await earlier).run, Object.keys(await told()).length], [2, 3])

shelf.look({ run: 4, wanted: [] })
assert.deepEqual([client.subscribed, shelf.topics.size, (await shelf.told()).run], [[], 0, 4])
shelf.stop()

assert.ok(covers('a/#', 'a/b/c') && covers('a/+', 'a/') && covers('a', 'a'))
assert.ok(!covers('a/+', 'a') && !covers('a/+', 'a/b/c') && !covers('a', 'b'))

console.log('ok')
