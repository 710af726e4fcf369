// What robots say of their bridges: the routes, and what is not bridged. Runs in the worker. Whoever may
// write `other/_appliance/routes` may say anything there, in the name of any number of robots: what comes
// of all but this one is bounded.

import { cut } from './formats.js'
import { isTopic } from './topic-name.js'

const LARGEST = 4 * 1024 * 1024 // bytes of a message
const LARGEST_OF_OTHERS = 1024 * 1024 // and as many are read in one go, as the worker also drives
const ROBOTS = 100 // others
const KEPT = 16 * 1024 * 1024 // bytes of their messages
const ROUTES = 10000 // of theirs: a page goes through all of them
const DEPTH = 8 // levels of JSON, of which the appliance uses five
const NAME = 1000 // characters of a topic or a type of theirs
const TEXT = 2000 // characters of another text of theirs
const MANY = 100 // values in a list or an object of theirs, and of what is not bridged

const TOPIC = /^([^/]*)\/_appliance\/(routes|skipped)$/

export const ABOUT = ['+/_appliance/routes', '+/_appliance/skipped']

export class About {
  /** `robot` is the name of this robot, of which everything is kept. */
  constructor(robot) {
    this.robot = robot
    this.others = new Map() // robot → {routes, skipped: bytes; count: routes}
    this.bytes = this.count = 0 // of the others
    this.changed = new Map() // topic → payload
  }

  take(topic, buffer) {
    const [, robot, what] = TOPIC.exec(topic) ?? []
    if (robot === undefined || buffer.length > (robot === this.robot ? LARGEST : LARGEST_OF_OTHERS)) return
    if (robot !== this.robot && !this.hasRoom(robot, what, buffer.length)) return
    // A copy: the buffer is a view of all that has come with it.
    this.changed.set(topic, new Uint8Array(buffer))
  }

  /** Whether another robot's message fits, which is then counted; one without bytes takes back the last. */
  hasRoom(robot, what, length) {
    const known = this.others.get(robot)
    if (known === undefined && (length === 0 || this.others.size >= ROBOTS)) return false
    const held = known ?? { routes: 0, skipped: 0, count: 0 }
    const bytes = this.bytes + length - held[what]
    if (bytes > KEPT) return false
    this.bytes = bytes
    held[what] = length
    if (held.routes + held.skipped > 0) this.others.set(robot, held)
    else this.forget(robot, held)
    return true
  }

  forget(robot, { count }) {
    this.count -= count
    this.others.delete(robot)
  }

  /** What has changed since the last time, a part: [robot, what, its value, undefined where there is none]. */
  told() {
    const told = []
    let bytes = 0
    for (const [topic, payload] of this.changed) {
      bytes += payload.length
      if (told.length > 0 && bytes > LARGEST_OF_OTHERS) break
      this.changed.delete(topic)
      const [, robot, what] = TOPIC.exec(topic)
      const value = said(payload)
      told.push([robot, what, what === 'skipped' ? this.skipped(robot, value) : this.routes(robot, value)])
    }
    return told
  }

  /** The routes of a robot: of another one as many as there is room for. */
  routes(robot, value) {
    if (robot === this.robot) return Array.isArray(value) ? value.filter(isRoute) : undefined
    const held = this.others.get(robot)
    if (held === undefined) return undefined
    const room = ROUTES - this.count + held.count
    const some = Array.isArray(value) ? value.slice(0, room).filter(isShort).map((route) => short(route, DEPTH)) : undefined
    this.count -= held.count
    held.count = some?.length ?? 0
    this.count += held.count
    return some
  }

  skipped(robot, value) {
    return robot === this.robot ? value : short(value, DEPTH)
  }
}

/**
 * Whether an entry of another robot is one, and can be shown. It names no topic with `$`: whoever calls or publishes
 * there means this appliance itself.
 */
function isShort(entry) {
  return isRoute(entry) && !entry.mqtt.startsWith('$') && ['ros', 'mqtt', 'type'].every((name) => entry[name].length <= NAME)
}

/** The value with its texts, lists and objects cut: a page shows no more, and nobody else minds what is in it. */
function short(value, levels) {
  if (typeof value === 'string') return cut(value, TEXT)
  if (value === null || typeof value !== 'object') return value
  if (levels === 0) return null
  if (Array.isArray(value)) return value.slice(0, MANY).map((each) => short(each, levels - 1))
  return Object.fromEntries(Object.entries(value).slice(0, MANY)
    .map(([name, each]) => [cut(name, NAME), short(each, levels - 1)]))
}

/** The value of a payload; undefined where it is none of the appliance's, which publishes JSON. */
function said(payload) {
  try {
    const value = JSON.parse(new TextDecoder().decode(payload))
    return isFlat(value, DEPTH) ? value : undefined
  } catch {
    return undefined
  }
}

/** Whether it has so many levels at most: what is nested without end cannot be handed to the page. */
function isFlat(value, levels) {
  if (value === null || typeof value !== 'object') return true
  return levels > 0 && Object.values(value).every((inner) => isFlat(inner, levels - 1))
}

/** Whether an entry has what all routes have; its topic and its type become parts of subscriptions. */
function isRoute(entry) {
  return ['ros', 'mqtt', 'type', 'direction'].every((name) => typeof entry?.[name] === 'string')
    && isTopic(`${entry.mqtt}/${entry.type}`)
}
