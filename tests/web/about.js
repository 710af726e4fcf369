// node about.js URL-of-the-console's-files: what strangers say in the name of robots is bounded; what this one says is kept.

import assert from 'node:assert/strict'

const { About } = await import(`${process.argv[2]}/about.js`)
const MIB = 1024 * 1024

const route = (more) => ({ ros: '/odom', mqtt: 'r/odom', type: 'nav_msgs/msg/Odometry', direction: 'to_mqtt', ...more })
const bytes = (value) => new TextEncoder().encode(typeof value === 'string' ? value : JSON.stringify(value))
const all = (about) => {
  const found = []
  for (let told = about.told(); told.length > 0; told = about.told()) found.push(...told)
  return found
}
const take = (about, robot, value, what = 'routes') => about.take(`${robot}/_appliance/${what}`, bytes(value))

// Told once, the newest of each; a view's bytes are copied, as MQTT.js writes over them.
let about = new About('r')
const buffer = bytes([route()])
about.take('r/_appliance/routes', buffer)
buffer.fill(0)
take(about, 'r', { count: 1 }, 'skipped')
take(about, 'r', { count: 2 }, 'skipped')
assert.deepEqual(about.told(), [['r', 'routes', [route()]], ['r', 'skipped', { count: 2 }]])
assert.deepEqual(about.told(), [])

// Other topics, and what is no JSON, no list, or nested so deep that it could not be handed to the page.
for (const topic of ['a', 'r/_appliance/state', 'r/_appliance/routes/x', 'x/r/_appliance/routes', '/routes']) {
  about.take(topic, bytes('[]'))
}
assert.deepEqual(about.told(), [])
const deep = (levels) => '['.repeat(levels) + ']'.repeat(levels)
for (const wrong of ['', '[', '{}', 'null', '7', deep(9), deep(500000), `[${JSON.stringify(route()).slice(0, -1)},"rules":${deep(100)}}]`]) {
  take(about, 'r', wrong)
  assert.deepEqual(about.told(), [['r', 'routes', undefined]], wrong.slice(0, 20))
}
take(about, 'r', [route({ rules: { clamp: { 'linear.x': [-1, 1] } } })])
assert.equal(about.told()[0][2][0].rules.clamp['linear.x'][1], 1)

// Entries that are no routes, and those whose topic or type would make a filter of a subscription.
const wrong = [null, 7, 'a', [], {}, route({ ros: 1 }), route({ mqtt: 'r/#' }), route({ mqtt: '+/odom' }), route({ type: '#' }),
  route({ mqtt: 'a\0b' }), route({ mqtt: 'a'.repeat(65536) })]
take(about, 'r', [...wrong, route()])
assert.deepEqual(about.told(), [['r', 'routes', [route()]]])

// Another robot names no topic of this appliance, nor a group of subscribers, whose messages a page would take.
const inside = [route({ mqtt: '$CONTROL/appliance/v1/reload' }), route({ mqtt: '$SYS/a' })]
const group = route({ mqtt: '$share/workers/jobs' })
take(about, 'r', [...inside, group])
assert.deepEqual(about.told(), [['r', 'routes', inside]])
take(about, 'eve', [...inside, group, route()])
assert.deepEqual(about.told(), [['eve', 'routes', [route()]]])

// So many robots; what is taken back, or was never there, takes no room.
about = new About('r')
for (let n = 0; n < 1000; n += 1) take(about, `x${n}`, '')
assert.deepEqual(about.told(), [])
for (let n = 0; n < 1000; n += 1) take(about, `x${n}`, [route()])
assert.equal(about.told().length, 100)
take(about, 'r', [route()])
assert.equal(about.told().length, 1)
take(about, 'x7', '')
take(about, 'y', [route()])
assert.deepEqual(about.told(), [['x7', 'routes', undefined], ['y', 'routes', [route()]]])

// So many bytes.
about = new About('r')
const large = (size) => [route({ why: 'x'.repeat(size) })]
for (let n = 0; n < 40; n += 1) take(about, `x${n}`, large(0.9 * MIB))
assert.equal(about.told().length, 1) // in a frame, as the worker also drives
assert.equal(all(about).length, 16)
take(about, 'x0', large(10))
take(about, 'z', large(0.9 * MIB), 'skipped')
assert.deepEqual(all(about).map(([robot, what]) => [robot, what]), [['x0', 'routes'], ['z', 'skipped']])
take(about, 'z', large(MIB))
take(about, 'r', large(4 * MIB))
assert.deepEqual(about.told(), [])
take(about, 'r', large(3 * MIB))
assert.equal(about.told()[0][2][0].why.length, 3 * MIB)

// Texts and lists of others, which a page would have to lay out.
about = new About('r')
const wide = { last_error: 'x'.repeat(9000), rules: { clamp: Array(200).fill(['x'.repeat(4000)]) } }
take(about, 'x1', [route(wide), route({ mqtt: 'a'.repeat(1001) }), ...Array(2000).fill(7)])
take(about, 'x1', { count: 1000, skipped: Array(110).fill({ last_error: wide.last_error }) }, 'skipped')
const [[, , [cutRoute, ...rest]], [, , cutList]] = all(about)
assert.deepEqual(
  [rest.length, cutRoute.last_error.length, cutRoute.rules.clamp.length, cutRoute.rules.clamp[0][0].length, cutRoute.mqtt],
  [0, 2001, 100, 2001, 'r/odom'],
)
assert.deepEqual([cutList.count, cutList.skipped.length, cutList.skipped[0].last_error.length], [1000, 100, 2001])

// So many routes of others, but all of this robot.
about = new About('r')
const many = (count) => Array.from({ length: count }, (_, n) => route({ mqtt: `t/${n}` }))
const counts = () => all(about).map(([, , { length }]) => length)
take(about, 'r', many(12000))
take(about, 'x', many(8000))
take(about, 'y', many(8000))
assert.deepEqual(counts(), [12000, 8000, 2000])
take(about, 'x', many(1000))
take(about, 'y', many(8000))
assert.deepEqual(counts(), [1000, 8000])
take(about, 'x', '{}')
take(about, 'y', '')
all(about)
take(about, 'z', many(11000))
assert.deepEqual(counts(), [10000])
console.log('ok')
