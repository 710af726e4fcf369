// The newest message of each topic, its rate, and what has changed since the page asked. Runs in the
// worker. Whoever may publish decides about names, payloads and properties: all of it is bounded.

import { cut, preview } from './formats.js'

const TOPICS = 20000 // that are kept; of more the number is told
const NAMES = 16 * 1024 * 1024 // characters of their names
const KEPT = 32 * 1024 * 1024 // bytes of messages, with their properties, that are kept whole
const CUT = 256 // bytes of a payload that is not
const CHANGES = 500 // topics in one answer to the page

export class Newest {
  constructor() {
    this.topics = new Map()
    this.changed = new Set()
    this.names = 0
    this.kept = 0
    this.untold = 0
  }

  take(topic, buffer, packet) {
    let entry = this.topics.get(topic)
    if (entry === undefined) {
      if (this.topics.size >= TOPICS || this.names + topic.length > NAMES) {
        this.untold += 1
        return
      }
      entry = { count: 0, before: 0, rate: 0, held: 0 }
      this.topics.set(topic, entry)
      this.names += topic.length
    }
    this.kept -= entry.held
    const size = packet.length ?? buffer.length // of all that the packet says
    entry.isWhole = this.kept + size <= KEPT
    // A copy: the buffer is a view of all that has come with it.
    entry.payload = new Uint8Array(entry.isWhole ? buffer : buffer.subarray(0, CUT))
    entry.properties = (entry.isWhole && packet.properties) || {}
    entry.held = entry.isWhole ? size : 0
    this.kept += entry.held
    entry.size = buffer.length
    entry.retain = packet.retain
    entry.qos = packet.qos
    entry.at = Date.now()
    entry.count += 1
    this.changed.add(topic)
  }

  /** Rates, once a second; a topic whose rate has changed is told again. */
  measure() {
    for (const [topic, entry] of this.topics) {
      if (entry.count < 2) {
        entry.before = entry.count
        continue // what comes once has no rate
      }
      const now = entry.count - entry.before
      entry.before = entry.count
      if (now === 0 && entry.rate === 0) continue
      const rate = now === 0 && entry.rate < 0.05 ? 0 : 0.7 * entry.rate + 0.3 * now
      if (rate.toFixed(1) !== entry.rate.toFixed(1)) this.changed.add(topic)
      entry.rate = rate
    }
  }

  /** Rows of what has changed: topic, text, size, rate, time, retained. */
  rows() {
    const rows = []
    for (const topic of this.changed) {
      if (rows.length >= CHANGES) break
      this.changed.delete(topic)
      const { payload, properties, size, rate, at, retain } = this.topics.get(topic)
      rows.push([topic, cut(preview(payload, properties), 200), size, rate, at, retain])
    }
    return rows
  }

  /** What is known of a topic, if that is all of its newest message. */
  whole(topic) {
    const entry = this.topics.get(topic)
    return entry?.isWhole ? entry : null
  }
}
