// node signing.js URL-of-the-console's-files: what becomes of a login that the robot answers in this way or that.

import assert from 'node:assert/strict'
import { EventEmitter } from 'node:events'
import { register } from 'node:module'

/** In the place of MQTT.js: a connection does what the test tells it to. */
const clients = []
globalThis.connect = (url, options) => {
  const client = Object.assign(new EventEmitter(), { options, connected: false, isOver: false })
  client.subscribe = (filters, how, done) => done(null, [], { granted: [0] })
  client.end = () => { client.isOver = true }
  clients.push(client)
  return client
}
const hooks = `export async function load(url, context, next) {
  if (!url.endsWith('/vendor/mqtt.esm.js')) return next(url, context)
  return { format: 'module', shortCircuit: true, source: 'export default { connect: globalThis.connect }' }
}`
register(`data:text/javascript,${encodeURIComponent(hooks)}`)
const answers = new Map()
globalThis.self = { postMessage: ({ number, answer }) => answers.get(number)(answer) }
await import(`${process.argv[2]}/worker.js`)

let number = 0
function ask(call, values) {
  number += 1
  const told = new Promise((resolve) => { answers.set(number, resolve) })
  self.onmessage({ data: { number, call, values } })
  return told
}

async function signIn(secret) {
  clients.length = 0
  await ask('signIn', { url: 'wss://robot/mqtt', user: 'alice', robot: 'robot', ...secret })
  const [client] = clients
  client.options.transformWsUrl('', null, client)
  return client
}

function refuse(client, code) {
  client.emit('error', Object.assign(new Error('in its words'), { code }))
  client.emit('close')
}

const state = async () => (await ask('frame')).state
const [PASSWORD, TOKEN] = [{ password: 'secret' }, { token: 'appliance-token-1' }]

for (const busy of [0x88, 0x89, 0x97, 0x9f]) {
  // A page that was loaded again has nothing but its token, which is as good in a second.
  let client = await signIn(TOKEN)
  for (let turn = 0; turn < 2; turn += 1) {
    refuse(client, busy)
    assert.deepEqual(await state(), { name: 'connecting', reason: 'The robot has no room now; trying again.' })
    assert.ok(!client.isOver)
  }
  client.emit('connect')
  assert.deepEqual(await state(), { name: 'in', reason: '' })
  // One that was signed in has lost its connection, and no more.
  client.emit('close')
  refuse(client, busy)
  assert.equal((await state()).name, 'lost')
  assert.ok(!client.isOver)
  client.emit('connect')
  assert.equal((await state()).name, 'in')
  // Who signs in with a password is told, and may try again.
  client = await signIn(PASSWORD)
  refuse(client, busy)
  assert.deepEqual(await state(), { name: 'refused', reason: 'in its words' })
  assert.ok(client.isOver)
}

// A token that has ended, and a connection that there is not.
refuse(await signIn(TOKEN), 0x87)
assert.equal((await state()).name, 'refused')
const client = await signIn(TOKEN)
client.emit('close')
assert.deepEqual(await state(), { name: 'failed', reason: 'No connection.' })

// What a page asks for as soon as it is there is not lost, however far the robot is.
const far = await signIn(TOKEN)
far.subscribe = () => {}
far.emit('connect')
assert.equal((await state()).name, 'in')
await ask('focus', { topic: 'a' })
assert.equal((await ask('frame')).focus?.topic, 'a')

console.log('ok')
process.exit()
