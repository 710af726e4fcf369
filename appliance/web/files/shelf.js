// What an open page keeps of some topics: the newest of each as text, over the connection of what is
// looked at. Runs in the worker. All is bounded; what is longer is cut, and says so.

import { cut, decode, isZstd, size } from './formats.js'

const TOPICS = 1000
const TEXT = 256 * 1024 // characters of one: the largest schema
const BYTES = 8 * 1024 * 1024 // that wait for the page in all
const CHANGES = 200 // topics in one answer to the page

export class Shelf {
  constructor(client) {
    this.client = client
    this.run = 0
    this.wanted = []
    this.clear()
    client.on('connect', () => this.subscribe())
    client.on('message', (topic, buffer, packet) => this.take(topic, buffer, packet))
    this.timer = setInterval(() => this.count(), 1000)
  }

  clear() {
    this.topics = new Map()
    this.changed = new Set()
    this.refused = []
    this.bytes = 0
  }

  stop() {
    clearInterval(this.timer)
  }

  /** Keep these from now on, each [filter, messages a second]; the page's `run` comes back with them. */
  look({ run, wanted }) {
    const before = this.wanted.map(([filter]) => filter)
    if (before.length && this.client.connected) this.client.unsubscribe(before)
    this.run = run
    this.wanted = wanted
    this.clear()
    if (this.client.connected) this.subscribe()
  }

  subscribe() {
    const run = this.run
    this.refused = []
    for (const [filter, rate] of this.wanted) {
      const properties = { userProperties: { 'max-rate': String(rate) } }
      this.client.subscribe(filter, { qos: 0, properties }, (error, granted, packet) => {
        const code = packet?.granted?.[0] ?? 0 // without a packet the connection was lost
        if (run === this.run && code >= 0x80) this.refused.push(filter)
      })
    }
  }

  take(topic, buffer, packet) {
    if (!this.wanted.some(([filter]) => covers(filter, topic))) return
    let entry = this.topics.get(topic)
    if (entry === undefined) {
      if (this.topics.size >= TOPICS) this.drop(this.topics.keys().next().value)
      entry = { payload: null, count: 0, before: 0, rate: 0 }
    } else {
      this.topics.delete(topic) // the oldest are first
      this.bytes -= entry.payload?.length ?? 0
    }
    this.topics.set(topic, entry)
    const isRoom = this.bytes + buffer.length <= BYTES
    // A copy: the buffer is a view of all that has come with it.
    entry.payload = new Uint8Array(isRoom ? buffer : buffer.subarray(0, 256))
    this.bytes += entry.payload.length
    entry.properties = kindOf(packet.properties ?? {})
    entry.size = buffer.length
    entry.at = Date.now()
    entry.count += 1
    this.changed.add(topic)
  }

  drop(topic) {
    this.bytes -= this.topics.get(topic).payload?.length ?? 0
    this.topics.delete(topic)
    this.changed.add(topic)
  }

  count() {
    for (const [topic, entry] of this.topics) {
      const rate = entry.count - entry.before
      entry.before = entry.count
      if (entry.count > 1 && rate !== entry.rate) this.changed.add(topic)
      entry.rate = entry.count > 1 ? rate : 0
    }
  }

  /** What has changed: [topic, {text, size, rate, at} or null for what is gone]. */
  async told() {
    // Of this run to the end: another may begin while a text is made, and has its own.
    const { run, refused, changed, topics } = this
    const changes = []
    for (const topic of changed) {
      if (changes.length >= CHANGES) break
      changed.delete(topic)
      const entry = topics.get(topic)
      if (!entry?.size) changes.push([topic, null])
      else changes.push([topic, { ...await words(entry), size: entry.size, rate: entry.rate, at: entry.at }])
    }
    return { run, refused, changes }
  }
}

/** The text of a message: JSON as it came, other encodings as lines of their values. */
async function words({ payload, properties, size: length }) {
  // The bridge compresses no calls: to unpack what somebody else sent would only cost.
  if (isZstd(properties)) return { text: `zstd, ${size(length)}`, isJson: false }
  const { kind, leaves, text } = await decode(payload, properties)
  if (kind === 'json' && payload.length === length) {
    return { text: cut(new TextDecoder().decode(payload), TEXT), isJson: length <= TEXT }
  }
  const lines = leaves?.map(([path, value]) => (path ? `${path}: ${value}` : value)).join('\n')
  return { text: cut(lines ?? text ?? kind, TEXT), isJson: false }
}

/** The properties that say what a payload is: others may be as large as it likes. */
function kindOf({ contentType = '', userProperties }) {
  const encoding = String(userProperties?.['content-encoding'] ?? '')
  return { contentType: cut(contentType, 100), userProperties: { 'content-encoding': cut(encoding, 100) } }
}

/** Whether a topic is under a filter. */
export function covers(filter, topic) {
  const wanted = filter.split('/')
  const parts = topic.split('/')
  for (const [index, part] of wanted.entries()) {
    if (part === '#') return true
    if (index >= parts.length || (part !== '+' && part !== parts[index])) return false
  }
  return wanted.length === parts.length
}
