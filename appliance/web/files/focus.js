// The topic that is looked at: every message up to FOCUS_RATE, its history, difference and plot.

import { ABOUT } from './about.js'
import { cut, decode, hexOf, preview } from './formats.js'

const FOCUS_RATE = '30'
const ABOUT_RATE = '2'
const HISTORY = 200 // messages
const HISTORY_BYTES = 16 * 1024 * 1024 // of them, with their properties
const DECODED = 4 // messages of which it is kept what they say: the one that is shown, and the one before
const POINTS = 3000
const SMALL = 64 * 1024 // bytes of a message of which every one is plotted

export class Focus {
  constructor(open, about) {
    this.topic = null
    this.clear()
    const client = open()
    this.client = client
    client.on('connect', () => {
      client.subscribe(ABOUT, { qos: 0, properties: { userProperties: { 'max-rate': ABOUT_RATE } } })
      if (this.topic !== null) this.subscribe()
    })
    client.on('error', () => {})
    client.on('message', (topic, buffer, packet) => {
      about.take(topic, buffer)
      if (topic === this.topic) this.take(new Uint8Array(buffer), packet, Date.now())
    })
  }

  clear() {
    this.history = []
    this.texts = new Map() // message → what it says, of those that were shown last
    this.bytes = 0
    this.number = 0
    this.path = null
    this.points = []
    this.shown = null
    this.paused = false
    this.isNew = true
    this.reason = ''
  }

  stop() {
    this.client.end(true)
  }

  subscribe() {
    const topic = this.topic
    const properties = { userProperties: { 'max-rate': FOCUS_RATE } }
    this.client.subscribe(topic, { qos: 0, properties }, (error, granted, packet) => {
      if (topic !== this.topic) return
      const code = packet?.granted?.[0] ?? 0 // without a packet the connection was lost
      this.reason = code >= 0x80 ? 'This user may not read this topic.' : ''
      this.isNew = true
    })
  }

  look(topic, known) {
    if (this.topic !== null && this.client.connected) {
      // What the appliance says about itself is listened to all the time.
      this.client.unsubscribe(this.topic)
    }
    this.clear()
    this.topic = topic || null
    if (this.topic === null) return
    if (known) {
      const { payload, properties, qos, retain, at, held } = known
      this.take(payload, { properties, qos, retain, length: held }, at)
    }
    if (this.client.connected) this.subscribe()
  }

  take(payload, packet, at) {
    if (this.paused) return
    const entry = {
      number: ++this.number,
      payload,
      size: packet.length ?? payload.length, // of all that the packet says
      at,
      qos: packet.qos,
      retain: packet.retain,
      properties: packet.properties ?? {},
    }
    const last = this.history.at(-1)
    // The survey's copy, once more: retained messages come again with the subscription.
    if (packet.retain && last && this.history.length === 1 && same(last.payload, payload)) {
      this.history.pop()
      this.bytes -= last.size
    }
    this.history.push(entry)
    this.bytes += entry.size
    while (this.history.length > 1 && (this.history.length > HISTORY || this.bytes > HISTORY_BYTES)) {
      this.bytes -= this.history.shift().size
    }
    this.isNew = true
    if (this.path !== null && payload.length <= SMALL) this.point(entry)
  }

  async point(entry) {
    const path = this.path
    const { leaves } = await this.decoded(entry)
    const found = leaves?.find(([name]) => name === path)
    if (found === undefined || found[2] === null || path !== this.path) return
    this.points.push([entry.at / 1000, found[2]])
    if (this.points.length > POINTS) this.points.shift()
  }

  /** What a message says. A few are kept: they are larger than the messages, which are counted. */
  decoded(entry) {
    const known = this.texts.get(entry)
    if (known) return known
    if (this.texts.size >= DECODED) this.texts.delete(this.texts.keys().next().value)
    const text = decode(entry.payload, entry.properties).catch((error) => ({
      kind: 'text', note: `cannot be shown: ${error?.message ?? error}`, text: '',
    }))
    this.texts.set(entry, text)
    return text
  }

  async plot(path) {
    this.path = path
    this.points = []
    this.isNew = true
    if (path === null) return
    for (const entry of [...this.history]) {
      if (entry.payload.length <= SMALL) await this.point(entry)
    }
  }

  show(number) {
    this.shown = number
    this.isNew = true
  }

  pause(paused) {
    this.paused = paused
    this.isNew = true
  }

  /** What the page shows; null when nothing is new. One picture is decoded at a time. */
  async told() {
    if (!this.isNew || this.busy) return null
    this.isNew = false
    this.busy = true
    try {
      return await this.describe()
    } finally {
      this.busy = false
    }
  }

  async describe() {
    const { topic, history, shown } = this
    let index = shown === null ? history.length - 1 : history.findIndex(({ number }) => number === shown)
    if (index < 0) index = history.length - 1
    const entry = history[index]
    const told = {
      topic,
      reason: this.reason,
      paused: this.paused,
      path: this.path,
      points: this.points.slice(),
      history: history.slice(-50).map((each) => [
        each.number, each.at, each.payload.length, cut(preview(each.payload, each.properties), 100),
      ]),
      kept: history.length,
      message: null,
    }
    if (entry === undefined) return told
    const now = await this.decoded(entry)
    const before = index > 0 ? await this.decoded(history[index - 1]) : null
    const old = before?.leaves ? new Map(before.leaves.map(([path, text]) => [path, text])) : null
    told.message = {
      number: entry.number,
      at: entry.at,
      size: entry.payload.length,
      qos: entry.qos,
      retain: entry.retain,
      properties: listed(entry.properties),
      kind: now.kind,
      note: now.note,
      text: now.text ?? null,
      leaves: now.leaves?.map(([path, text, value]) => {
        const was = old === null ? text : old.get(path)
        return [path, text, value !== null, was === text ? null : was ?? '(not there)']
      }) ?? null,
    }
    if (now.picture) {
      try {
        told.bitmap = await createImageBitmap(now.picture)
        told.message.note = `${now.note} ${told.bitmap.width} × ${told.bitmap.height}`
      } catch {
        told.message.note = 'a picture that cannot be read'
      }
    }
    if (topic !== this.topic) {
      told.bitmap?.close()
      return null
    }
    return told
  }

  /** The history as lines of JSON. */
  export() {
    const lines = this.history.map(({ payload, at, qos, retain, properties }) => {
      let said
      try {
        said = { payload: new TextDecoder('utf-8', { fatal: true }).decode(payload) }
      } catch {
        said = { payload_base64: base64(payload) }
      }
      const time = new Date(at).toISOString()
      return JSON.stringify({ time, topic: this.topic, qos, retain, properties: listed(properties), ...said })
    })
    return new Blob([lines.map((line) => `${line}\n`).join('')], { type: 'application/octet-stream' })
  }
}

function base64(bytes) {
  let text = ''
  for (let at = 0; at < bytes.length; at += 8192) text += String.fromCharCode(...bytes.subarray(at, at + 8192))
  return btoa(text)
}

function same(one, other) {
  return one.length === other.length && one.every((byte, index) => byte === other[index])
}

const NAMES = {
  payloadFormatIndicator: 'payload format',
  messageExpiryInterval: 'expires in (s)',
  contentType: 'content type',
  responseTopic: 'response topic',
  correlationData: 'correlation data',
  subscriptionIdentifier: 'subscription identifier',
}

/** MQTT 5 properties as pairs of text: their names are a stranger's. */
function listed(properties) {
  const pairs = []
  for (const [name, label] of Object.entries(NAMES)) {
    const value = properties[name]
    if (value === undefined) continue
    const text = value instanceof Uint8Array ? hexOf(value.subarray(0, 64)) : String(value)
    pairs.push([label, name === 'payloadFormatIndicator' ? (value ? 'UTF-8' : 'bytes') : cut(text, 500)])
  }
  for (const [name, values] of Object.entries(properties.userProperties ?? {})) {
    for (const value of [values].flat().slice(0, 20)) pairs.push([cut(name, 200), cut(String(value), 500)])
    if (pairs.length > 100) break
  }
  return pairs
}
