// node bounds.js URL-of-the-console's-files: what the worker keeps is bounded, whatever comes.

import assert from 'node:assert/strict'

const { Newest } = await import(`${process.argv[2]}/newest.js`)
const { Focus } = await import(`${process.argv[2]}/focus.js`)
const KIB = 1024

/** A message of which most bytes are its properties. */
function packet(size) {
  return { length: size, qos: 0, retain: false, properties: { userProperties: { a: 'x' } } }
}

// Names and properties count as payloads do.
let newest = new Newest()
const payload = new Uint8Array(10)
for (let n = 0; n < 2000; n += 1) newest.take(`t/${n}`, payload, packet(32 * KIB))
assert.ok(newest.kept <= 32 * KIB * KIB && newest.topics.size === 2000, `${newest.kept} bytes`)
assert.ok(newest.whole('t/0') && !newest.whole('t/1999'))
assert.deepEqual(newest.topics.get('t/1999').properties, {})
for (let n = 0; n < 2000; n += 1) newest.take(`t/${n}`, payload, packet(20))
assert.equal(newest.kept, 2000 * 20)
assert.ok(newest.whole('t/1999'))
newest = new Newest()
for (let n = 0; n < 2000; n += 1) newest.take(`${'n'.repeat(30 * KIB)}/${n}`, payload, packet(30 * KIB))
assert.ok(newest.names <= 16 * KIB * KIB && newest.kept <= 32 * KIB * KIB && newest.untold > 0)

// Rows are told once, and no more than fit an answer.
newest = new Newest()
for (let n = 0; n < 600; n += 1) newest.take(`t/${n}`, payload, packet(20))
assert.deepEqual([newest.rows().length, newest.rows().length, newest.rows().length], [500, 100, 0])

// The history of the topic that is looked at.
const client = { connected: false, on() {}, end() {} }
const focus = new Focus(() => client, null)
focus.look('t', null)
for (let n = 0; n < 100; n += 1) focus.take(payload, packet(1024 * KIB), n)
assert.ok(focus.bytes <= 16 * KIB * KIB && focus.history.length === 16, `${focus.history.length}`)

// What the messages of the history say is larger than they are: it is kept of a few.
const nested = `{"${Array(60).fill('k'.repeat(200)).join('":{"')}":[${Array(900).fill(1).join()}]${'}'.repeat(60)}`
const nesting = new Focus(() => client, null)
nesting.look('t', null)
for (let n = 0; n < 100; n += 1) {
  nesting.take(new TextEncoder().encode(nested), packet(nested.length), n)
  const { message } = await nesting.told()
  assert.ok(message.leaves.length === 900 && message.leaves.every(([path]) => path.length <= 501))
}
assert.ok(nesting.history.length === 100 && nesting.texts.size <= 4)
// Messages of TF that wait while one is read.
const { default: MapView } = await import(`${process.argv[2]}/map-link.js`)
const heard = {}
const robot = { on(event, take) { heard[event] = take }, subscribe() {}, end() {} }
const view = new MapView(() => robot, { topics: {}, tf: [['tf', false], ['tf_static', true]] })
for (const topic of ['tf', 'tf_static']) {
  for (let n = 0; n < 100; n += 1) heard.message(topic, new Uint8Array(1024 * KIB), {})
  for (let n = 0; n < 600; n += 1) heard.message(topic, new Uint8Array(1 + n % 2), {})
}
for (const waiting of [view.told, view.toldOnce]) {
  assert.equal(waiting.messages.length, 500)
  assert.equal(waiting.bytes, 750)
  for (let n = 0; n < 100; n += 1) waiting.add({ payload: new Uint8Array(1024 * KIB) })
  assert.ok(waiting.bytes === 8 * KIB * KIB && waiting.messages.length === 8)
  waiting.add({ payload: new Uint8Array(17 * KIB * KIB) })
  assert.deepEqual([waiting.take(), waiting.bytes], [[], 0])
}
console.log('ok')
