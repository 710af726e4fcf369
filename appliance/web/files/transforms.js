// Where the frames of a robot are to each other (TF), from messages of strangers: how many, for how
// long and how far apart they may be is bounded. In metres; times in seconds.

import { field, numberAt, textAt } from './values.js'

const MOST_FRAMES = 500
const MOST_IN_MESSAGE = 1000
const HISTORY = 200 // transforms of a frame, to know it at the time of a scan
const AGE = 10 // s for which a moving frame is where it was
const DEEPEST = 100 // frames from one to its root
const FARTHEST = 1e6 // m

const IDENTITY = { x: 0, y: 0, z: 0, q: [0, 0, 0, 1] }

export class Transforms {
  /** `clock` is in seconds. */
  constructor(clock = () => performance.now() / 1000) {
    this.clock = clock
    this.frames = new Map() // child → {parent, isStatic, samples: [{stamp, at, x, y, z, q}]}
    this.problem = ''
  }

  /** Take a TFMessage; what is wrong in it is in `problem`. */
  take(message, isStatic) {
    const found = field(message, 'transforms')
    if (!Array.isArray(found)) throw new Error('no transforms in its field transforms')
    for (const each of found.slice(0, MOST_IN_MESSAGE)) this.takeOne(each, isStatic)
  }

  takeOne(message, isStatic) {
    const parent = frameAt(message, 'header', 'frame_id')
    const child = frameAt(message, 'child_frame_id')
    const place = placeOf(field(message, 'transform'))
    if (!parent || !child || parent === child || place === null) {
      this.problem = `TF has a transform that is none, from ${parent || '(no name)'} to ${child || '(no name)'}.`
      return
    }
    this.forget()
    const known = this.frames.get(child)
    if (known === undefined && this.frames.size >= MOST_FRAMES) {
      this.problem = `TF has more than ${MOST_FRAMES} frames: others are left out.`
      return
    }
    // With another parent, or from a clock that was set back, what was before says nothing.
    const stamp = stampOf(message)
    const behind = known ? known.samples.at(-1).stamp - stamp : 0
    const goesOn = known && known.parent === parent && !isStatic && !known.isStatic && behind <= AGE
    if (goesOn && behind > 0) return // it comes late, and newer ones are known
    const samples = goesOn ? known.samples : []
    samples.push({ stamp, at: this.clock(), ...place })
    if (samples.length > HISTORY) samples.shift()
    this.frames.set(child, { parent, isStatic, samples })
  }

  /** Frames that nobody tells any more make room. */
  forget() {
    if (this.frames.size < MOST_FRAMES) return
    for (const [child, frame] of this.frames) if (!this.isKnown(frame)) this.frames.delete(child)
  }

  isKnown({ isStatic, samples }) {
    return isStatic || this.clock() - samples.at(-1).at <= AGE
  }

  /**
   * How what is in the frame `source` lies in the plane of `target`, at a time: {a, b, c, d, x, y},
   * see `moved`. Throws an Error that says which frame is missing.
   */
  between(source, target, stamp) {
    const up = this.toRoot(source, stamp)
    const down = this.toRoot(target, stamp)
    const common = [...up.keys()].find((frame) => down.has(frame))
    if (common === undefined) throw new Error(`TF has no way from ${source} to ${target}: it ends at ${last(up)} and at ${last(down)}.`)
    return flat(composed(inverse(down.get(common)), up.get(common)))
  }

  /** Of each frame from this one to its root, where this one is in it. */
  toRoot(frame, stamp) {
    const found = new Map([[frame, IDENTITY]])
    for (let at = frame, place = IDENTITY; ;) {
      const known = this.frames.get(at)
      if (known === undefined || !this.isKnown(known)) return found
      if (found.has(known.parent)) throw new Error(`TF goes round in a circle: ${known.parent} is above and below ${at}.`)
      if (found.size > DEEPEST) throw new Error(`TF has more than ${DEEPEST} frames one above the other.`)
      place = composed(sampleAt(known.samples, stamp), place)
      at = known.parent
      found.set(at, place)
    }
  }
}

/** A point, moved by what `between` has told. */
export function moved({ a, b, c, d, x, y }, px, py) {
  return [a * px + b * py + x, c * px + d * py + y]
}

/** A frame's name; ROS 1's may begin with a slash. */
export function withoutSlash(name) {
  return name.startsWith('/') ? name.slice(1) : name
}

/** The time of a message's header, 0 without one. */
export function stampOf(message) {
  const part = (...names) => names.map((name) => numberAt(message, 'header', 'stamp', name)).find(Number.isFinite) ?? 0
  return part('sec', 'secs') + part('nanosec', 'nsecs') / 1e9
}

function frameAt(message, ...path) {
  return withoutSlash(textAt(message, ...path))
}

function last(places) {
  return [...places.keys()].at(-1)
}

/** A transform with a quaternion of length 1; null where it is none. */
function placeOf(transform) {
  const [x, y, z] = ['x', 'y', 'z'].map((name) => numberAt(transform, 'translation', name))
  const q = normal(['x', 'y', 'z', 'w'].map((name) => numberAt(transform, 'rotation', name)))
  return q !== null && [x, y, z].every((value) => Math.abs(value) < FARTHEST) ? { x, y, z, q } : null
}

function normal(q) {
  const length = Math.hypot(...q)
  return length > 1e-3 && length < 1e3 ? q.map((value) => value / length) : null
}

/** Where a frame was at a time, between the two samples around it; the nearest one outside of them. 0 is now. */
function sampleAt(samples, stamp) {
  if (stamp === 0) return samples.at(-1)
  const next = samples.findIndex((sample) => sample.stamp >= stamp)
  if (next <= 0) return samples.at(next) // 0, or -1: the last
  const [one, other] = [samples[next - 1], samples[next]]
  const share = (stamp - one.stamp) / (other.stamp - one.stamp)
  const mix = (from, to) => from + share * (to - from)
  const side = one.q.reduce((sum, value, index) => sum + value * other.q[index], 0) < 0 ? -1 : 1
  const q = normal(one.q.map((value, index) => mix(value, side * other.q[index]))) ?? other.q
  return { x: mix(one.x, other.x), y: mix(one.y, other.y), z: mix(one.z, other.z), q }
}

/** `inner`, which is in the frame that lies at `outer`, seen from there. */
function composed(outer, inner) {
  const [x, y, z] = turned(outer.q, inner)
  return { x: outer.x + x, y: outer.y + y, z: outer.z + z, q: normal(product(outer.q, inner.q)) ?? IDENTITY.q }
}

function inverse({ q: [x, y, z, w], ...place }) {
  const q = [-x, -y, -z, w]
  const [dx, dy, dz] = turned(q, place)
  return { x: -dx, y: -dy, z: -dz, q }
}

function product([ax, ay, az, aw], [bx, by, bz, bw]) {
  return [
    aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz,
  ]
}

function turned(q, { x, y, z }) {
  return product(product(q, [x, y, z, 0]), [-q[0], -q[1], -q[2], q[3]])
}

/** What it does with points of the plane z = 0. */
function flat({ x, y, q: [qx, qy, qz, qw] }) {
  return {
    a: 1 - 2 * (qy * qy + qz * qz), b: 2 * (qx * qy - qw * qz), c: 2 * (qx * qy + qw * qz), d: 1 - 2 * (qx * qx + qz * qz), x, y,
  }
}
