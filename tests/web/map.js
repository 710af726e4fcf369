// node map.js URL-of-the-console's-files: grids, poses and scans of strangers, and the viewport.

import assert from 'node:assert/strict'

const load = (name) => import(`${process.argv[2]}/${name}.js`)
const { MOST_CELLS, cloudOf, gridOf, pixelsOf, poseOf, scanOf } = await load('geometry')
const { valueOf } = await load('values')
const { arranged, corners } = await load('arrange')
const { START, fitted, panned, zoomed } = await load('viewport')
const near = (one, other) => assert.ok(Math.abs(one - other) < 1e-5, `${one} is not ${other}`)
const json = (value) => valueOf(new TextEncoder().encode(JSON.stringify(value)), { contentType: 'application/json' })
const cbor = (text) => valueOf(Uint8Array.from(Buffer.from(text.replaceAll(' ', ''), 'hex')), { contentType: 'application/cbor' })
const rejects = async (read, message, words) => {
  const value = await json(message)
  assert.throws(() => read(value), (error) => { assert.match(error.message, words); return true })
}

// Grids.
const turn = (yaw) => ({ x: 0, y: 0, z: Math.sin(yaw / 2), w: Math.cos(yaw / 2) })
const pose = (x, y, yaw) => ({ position: { x, y, z: 0 }, orientation: turn(yaw) })
const header = (frame) => ({ stamp: { sec: 0, nanosec: 0 }, frame_id: frame })
const info = { resolution: 0.5, width: 3, height: 2, origin: pose(-1, -2, 0) }
const grid = { header: header('map'), info, data: [0, 100, -1, 50, 127, -128] }
let read = gridOf(await json(grid))
assert.deepEqual([read.frame, read.width, read.height, read.resolution, read.x, read.y, read.yaw], ['map', 3, 2, 0.5, -1, -2, 0])
const pixels = pixelsOf(read)
const shades = [0, 1, 2, 3, 4, 5].map((cell) => pixels[cell * 4])
assert.deepEqual(shades, [255, 25, 0x9a, 140, 0x9a, 0x9a])
assert.ok([3, 7, 23].every((at) => pixels[at] === 255))
assert.deepEqual([...corners(read)], [-1, -2, 0.5, -2, 0.5, -1, -1, -1])
const with_ = (more) => ({ ...grid, info: { ...info, ...more } })
await rejects(gridOf, {}, /no cells/)
await rejects(gridOf, null, /no cells/)
await rejects(gridOf, { ...grid, data: 'AAAA' }, /no cells/)
await rejects(gridOf, { ...grid, data: { length: 6 } }, /no cells/)
await rejects(gridOf, { ...grid, data: [0] }, /3 × 2 cells, and 1/)
for (const width of [0, -3, 1.5, null, '3', 2 ** 60]) await rejects(gridOf, with_({ width }), /no size|at most/)
await rejects(gridOf, with_({ width: 65536, height: 65536 }), new RegExp(`at most ${MOST_CELLS}`))
for (const resolution of [0, -1, null, 'x', 1e300]) await rejects(gridOf, with_({ resolution }), /resolution|too large/)
for (const x of [null, 1e300, '1']) await rejects(gridOf, with_({ origin: { ...pose(0, 0, 0), position: { x, y: 0, z: 0 } } }), /position/)
read = gridOf(await json(with_({ origin: { position: { x: 0, y: 0 }, orientation: { x: 0, y: 0, z: 0, w: 0 } } })))
assert.equal(read.yaw, 0)
assert.ok(pixelsOf(gridOf(await json({ ...grid, data: [null, 'x', 3.7, 1e300, [], {}] }))))

// As CBOR, with the cells as a typed array.
const head = 'a2 64696e666f a4 6577696474681903e8 6668656967687419 03e8 6a7265736f6c7574696f6e fb3fa999999999999a'
const origin = '666f726967696e a1 68706f736974696f6e a2 617800 617900'
const large = await cbor(`${head} ${origin} 6464617461 d848 5a000f4240 ${'64'.repeat(1e6)}`)
read = gridOf(large)
assert.ok(read.cells instanceof Int8Array && pixelsOf(read).length === 4e6)

// Poses.
for (const message of [{ header: header('odom'), pose: pose(1, 2, 3) }, { header: header('odom'), child_frame_id: 'base', pose: { pose: pose(1, 2, 3) } }]) {
  const found = poseOf(await json(message))
  assert.deepEqual([found.frame, found.x, found.y], ['odom', 1, 2])
  near(found.yaw, 3)
}
for (const orientation of [undefined, null, {}, { x: 0, y: 0, z: 0, w: 0 }, { x: null, y: 0, z: 0, w: 1 }, { x: 1e200, y: 0, z: 0, w: 1 }]) {
  assert.equal(poseOf(await json({ pose: { position: { x: 1, y: 2 }, orientation } })).yaw, null)
}
near(poseOf(await json({ pose: { position: { x: 0, y: 0 }, orientation: { x: 0, y: 0, z: 3, w: 3 } } })).yaw, Math.PI / 2)
await rejects(poseOf, {}, /position/)
await rejects(poseOf, { pose: { position: { x: null, y: 0 } } }, /position/)
await rejects(poseOf, { pose: { position: { x: 1e9, y: 0 } } }, /position/)

// Scans.
const scan = { header: header('laser'), angle_min: 0, angle_increment: Math.PI / 2, range_min: 0.1, range_max: 10, ranges: [1, 2, null, 0.01, 11] }
read = scanOf(await json(scan))
assert.equal(read.frame, 'laser')
assert.equal(read.points.length, 4)
read.points.forEach((value, at) => near(value, [1, 0, 0, 2][at]))
assert.equal(scanOf(await json({ ...scan, range_min: null, range_max: null })).points.length, 8)
assert.equal(scanOf(await json({ ...scan, ranges: ['x', {}, [], true, 1e300] })).points.length, 0)
await rejects(scanOf, { ...scan, angle_increment: null }, /angles/)
await rejects(scanOf, { ...scan, ranges: 'AAAA' }, /no distances/)
await rejects(scanOf, [], /no distances/)

// Clouds of points.
const cell = Buffer.alloc(24)
;[1, 2, 3, NaN, 5, 6].forEach((value, at) => cell.writeFloatLE(value, at * 4))
const fields = ['x', 'y', 'z'].map((name, at) => ({ name, offset: at * 4, datatype: 7, count: 1 }))
const cloud = { header: header('laser'), width: 2, height: 1, point_step: 12, row_step: 24, is_bigendian: false, fields, data: cell.toString('base64') }
assert.deepEqual([...cloudOf(await json(cloud)).points], [1, 2])
for (const more of [{ point_step: 0 }, { width: 3 }, { row_step: 12 }, { height: 2 ** 40 }, { width: null }, { data: '' }]) {
  await rejects(cloudOf, { ...cloud, ...more }, /points of/)
}
for (const more of [{ fields: [] }, { fields: 'x' }, { fields: fields.map((each) => ({ ...each, offset: 10 })) }, { fields: fields.map((each) => ({ ...each, datatype: 4 })) }]) {
  await rejects(cloudOf, { ...cloud, ...more }, /no field x/)
}
await rejects(cloudOf, { ...cloud, data: null }, /no bytes/)

// Frames.
const points = Float32Array.of(1, 0)
const robot = { frame: 'map', child: 'base', x: 1, y: 2, yaw: Math.PI / 2 }
const at = (parts) => [...(arranged(parts).points ?? [])].map((value) => Math.round(value * 1e5) / 1e5)
const notes = (parts) => arranged(parts).notes.join(' ')
const map = { frame: '/map' }
assert.deepEqual(at({ grid: map, pose: robot, scan: { frame: 'base', points } }), [1, 3])
assert.equal(notes({ grid: map, pose: robot, scan: { frame: '/base', points } }), '')
assert.match(notes({ grid: map, pose: robot, scan: { frame: 'laser', points } }), /laser.*TF.*not bridged.*middle/)
assert.deepEqual(at({ grid: map, pose: robot, scan: { frame: 'map', points } }), [1, 0])
assert.match(notes({ grid: map, pose: { ...robot, frame: 'odom' } }), /odom.*map.*not bridged/)
assert.match(notes({ grid: map, scan: { frame: 'laser', points } }), /not drawn/)
assert.match(notes({ grid: map, pose: { ...robot, yaw: null }, scan: { frame: 'laser', points } }), /no heading.*not drawn/)
assert.deepEqual(at({ scan: { frame: 'laser', points } }), [1, 0])
assert.deepEqual(arranged({}), { frame: '(without a name)', pose: null, points: null, notes: [] })

// Transforms: through the frames, at the time of the message, whatever a stranger says.
const { Transforms, moved } = await load('transforms')
let now = 0
const tf = (from, to, x, y, rotation, sec = 1) => ({
  header: { stamp: { sec, nanosec: 0 }, frame_id: from }, child_frame_id: to, transform: { translation: { x, y, z: 0 }, rotation },
})
const told = (...all) => {
  const found = new Transforms(() => now)
  found.take({ transforms: all }, false)
  return found
}
const goes = (transforms, source, target, stamp, from, to) => moved(transforms.between(source, target, stamp), ...from).forEach((value, index) => near(value, to[index]))
const quarter = turn(Math.PI / 2)
const tree = told(tf('/map', 'odom', 10, 0, turn(0)), tf('odom', '/base', 1, 2, quarter), tf('base', 'laser', 0.5, 0, quarter), tf('map', 'dock', 3, 0, quarter))
goes(tree, 'base', 'map', 0, [1, 0], [11, 3])
goes(tree, 'laser', 'map', 0, [1, 0], [10, 2.5])
goes(tree, 'laser', 'dock', 0, [1, 0], [2.5, -7])
goes(tree, 'map', 'base', 0, [11, 3], [1, 0])
goes(tree, 'base', 'base', 0, [1, 2], [1, 2])
// Mounted upside down, and on its side.
goes(told(tf('base', 'laser', 0, 0, { x: 1, y: 0, z: 0, w: 0 })), 'laser', 'base', 0, [1, 2], [1, -2])
goes(told(tf('base', 'laser', 0, 0, { x: Math.SQRT1_2, y: 0, z: 0, w: Math.SQRT1_2 })), 'laser', 'base', 0, [1, 2], [1, 0])
// Quaternions that are not normalized, and what is none.
goes(told(tf('map', 'base', 0, 0, { x: 0, y: 0, z: 7, w: 7 })), 'base', 'map', 0, [1, 0], [0, 1])
for (const bad of [tf('map', 'base', 0, 0, {}), tf('map', 'base', 0, 0, { x: 0, y: 0, z: 0, w: 0 }), tf('map', 'base', null, 0, turn(0)), tf('map', 'base', 1e9, 0, turn(0)),
  tf('map', 'base', 0, 0, { x: 1e200, y: 0, z: 0, w: 1 }), tf('base', '/base', 0, 0, turn(0)), tf('', 'base', 0, 0, turn(0)), null, 5, [], { child_frame_id: {} }]) {
  const found = told(bad)
  assert.match(found.problem, /transform that is none/)
  assert.equal(found.frames.size, 0)
}
for (const bad of [null, [], {}, { transforms: 'x' }, { transforms: { length: 3 } }]) assert.throws(() => new Transforms().take(bad), /no transforms/)
// Absent parents, circles, chains without end.
assert.throws(() => tree.between('laser', 'moon', 0), /no way from laser to moon: it ends at map and at moon/)
assert.throws(() => told(tf('a', 'b', 0, 0, turn(0)), tf('b', 'a', 0, 0, turn(0))).between('a', 'map', 0), /circle/)
const chain = told(...Array.from({ length: 400 }, (_, each) => tf(`f${each + 1}`, `f${each}`, 1, 0, turn(0))))
assert.throws(() => chain.between('f0', 'f400', 0), /more than 100 frames/)
// Between two samples, and outside of them.
const turning = told(tf('map', 'base', 0, 0, turn(0), 10), tf('map', 'base', 2, 0, quarter, 12))
goes(turning, 'base', 'map', 11, [1, 0], [1 + Math.SQRT1_2, Math.SQRT1_2])
goes(turning, 'base', 'map', 5, [1, 0], [1, 0])
goes(turning, 'base', 'map', 99, [1, 0], [2, 1])
goes(turning, 'base', 'map', 0, [1, 0], [2, 1])
goes(told(tf('map', 'base', 0, 0, turn(3), 10), tf('map', 'base', 0, 0, { x: 0, y: 0, z: -Math.sin(1.6), w: -Math.cos(1.6) }, 12)), 'base', 'map', 11,
  [1, 0], [Math.cos(3.1), Math.sin(3.1)])
turning.take({ transforms: [tf('map', 'base', 7, 7, turn(0), 11)] }, false) // it comes late: what is newer holds
goes(turning, 'base', 'map', 11, [1, 0], [1 + Math.SQRT1_2, Math.SQRT1_2])
goes(turning, 'base', 'map', 99, [1, 0], [2, 1])
turning.take({ transforms: [tf('map', 'base', 5, 0, turn(0), 1)] }, false) // the clock was set back
goes(turning, 'base', 'map', 11, [0, 0], [5, 0])
// Old ones end, static ones do not; what there is of them is bounded.
turning.take({ transforms: [tf('base', 'laser', 1, 0, turn(0))] }, true)
now = 11
assert.throws(() => turning.between('laser', 'map', 0), /ends at base/)
goes(turning, 'laser', 'base', 0, [0, 0], [1, 0])
const flood = new Transforms(() => now)
for (let each = 0; each < 20; each++) flood.take({ transforms: Array.from({ length: 2000 }, (_, one) => tf('map', `n${each}-${one}`, 0, 0, turn(0))) }, false)
assert.equal(flood.frames.size, 500)
assert.match(flood.problem, /more than 500/)
now = 30
flood.take({ transforms: [tf('map', 'new', 1, 0, turn(0))] }, false)
goes(flood, 'new', 'map', 0, [0, 0], [1, 0])
for (let each = 0; each < 1000; each++) flood.take({ transforms: [tf('map', 'new', 1, 0, turn(0), each + 1)] }, false)
assert.equal(flood.frames.get('new').samples.length, 200)
goes(told(tf('map', '__proto__', 1, 0, turn(0))), '__proto__', 'map', 0, [0, 0], [1, 0])
// What is drawn by them.
now = 0
const place = tree.between('laser', 'map', 0)
assert.deepEqual(at({ grid: map, scan: { frame: 'laser', points }, tf: { scan: { place } } }), [10, 2.5])
const drawn = arranged({ grid: map, pose: { ...robot, frame: 'odom' }, tf: { pose: { place: tree.between('odom', 'map', 0) } } })
assert.deepEqual([drawn.pose.x, drawn.pose.y, drawn.notes], [11, 2, []])
assert.match(notes({ grid: map, scan: { frame: 'laser', points }, tf: { scan: { problem: 'TF has no way.' } } }), /laser.*not drawn. TF has no way/)

// The viewport: what is under the pointer stays there, and nothing leaves what can be drawn.
const below = (view, right, down) => [view.x + right / view.scale, view.y - down / view.scale]
const zoomedIn = zoomed(START, 2, 30, -40)
below(zoomedIn, 30, -40).forEach((value, index) => near(value, below(START, 30, -40)[index]))
assert.equal(zoomedIn.scale, START.scale * 2)
assert.deepEqual(panned(START, 50, 0), { x: -1, y: 0, scale: 50 })
assert.deepEqual(fitted([], 100, 100), START)
assert.deepEqual(fitted([NaN, NaN], 100, 100), START)
const whole = fitted([-10, -5, 10, 5], 400, 400)
assert.deepEqual([whole.x, whole.y], [0, 0])
near(whole.scale, 0.92 * 20)
assert.ok(fitted([-1e9, 0, 1e9, 0], 100, 100).scale >= 1e-3)
let view = START
for (let each = 0; each < 1000; each++) view = zoomed(panned(view, -1e9, 1e9), each % 2 ? 10 : 0.001, 500, 500)
assert.ok(Object.values(view).every(Number.isFinite))
console.log('ok')
