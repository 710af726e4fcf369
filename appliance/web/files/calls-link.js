// The connection for calls, and for what is published once. It never reconnects: MQTT.js would send
// again what was not acknowledged, and nobody wants a command twice. The next call opens another one.
// An answer comes below `_reply/{client id}`, which needs no right to write (docs/calls.md).

import { valueOf } from './json-text.js'

const PACKET = 2 * 1024 * 1024
const TIMEOUT = 10000 // ms for an answer
const REFUSED = 0x80 // reason codes from here on
const NO_MATCHING_SUBSCRIBERS = 0x10
const UNKNOWN = 'The connection was lost: whether it was carried out is not known.'

export class Calls {
  constructor(open) {
    this.waiting = new Map() // token → {resolve, reject}
    this.listened = new Map() // filter → the promise of its subscription
    this.isOver = false
    this.client = open({ reconnectPeriod: 0 }, PACKET)
    this.id = this.client.options.clientId
    this.connected = new Promise((resolve, reject) => {
      this.client.once('connect', resolve)
      this.client.once('close', () => reject(new Error('No connection to the robot now.')))
    })
    this.connected.catch(() => {})
    this.client.on('error', () => {})
    this.client.on('close', () => {
      this.isOver = true
      this.fail(UNKNOWN)
      this.client.end(true) // else who waits for a PUBACK is told nothing
    })
    this.client.on('message', (topic, buffer, packet) => this.take(topic, buffer, packet))
  }

  stop() {
    this.isOver = true
    this.client.end(true)
    this.fail('Signed out.')
  }

  fail(reason) {
    for (const { reject } of this.waiting.values()) reject(new Error(reason))
    this.waiting.clear()
  }

  /** The answer to a call, as text. Rejects with the words of what went wrong. */
  async request({ topic, payload = '', timeout = TIMEOUT }) {
    const above = topic.slice(0, topic.lastIndexOf('/'))
    const token = crypto.getRandomValues(new Uint32Array(2)).join('-')
    let timer = null
    const late = new Promise((resolve, reject) => {
      timer = setTimeout(() => reject(new Error(`No answer within ${timeout / 1000} s, or one of more than 2 MiB.`)), timeout)
    })
    try {
      return await Promise.race([late, this.carryOut(topic, payload, above, token)])
    } finally {
      clearTimeout(timer)
      this.waiting.delete(token)
    }
  }

  async carryOut(topic, payload, above, token) {
    await this.connected
    await this.listen(above)
    const answer = new Promise((resolve, reject) => {
      this.waiting.set(token, { resolve, reject })
    })
    answer.catch(() => {}) // the publication below may fail first
    const properties = {
      contentType: 'application/json',
      responseTopic: `${above}/_reply/${this.id}/${token}`,
      correlationData: new TextEncoder().encode(token),
    }
    const { code, words } = await this.publish({ topic, payload, qos: 1, properties })
    if (code >= REFUSED) throw new Error(words)
    if (code === NO_MATCHING_SUBSCRIBERS) throw new Error(`Nothing takes calls at ${topic} now.`)
    return answer
  }

  listen(above) {
    const filter = `${above}/_reply/${this.id}/#`
    const known = this.listened.get(filter)
    if (known) return known
    const subscribed = new Promise((resolve, reject) => {
      this.client.subscribe(filter, { qos: 1 }, (error, granted, packet) => {
        if (error && !packet) reject(new Error('No connection to the robot now.'))
        else if (!(packet?.granted?.[0] >= REFUSED)) resolve()
        else reject(new Error(`This user may not read its answers: pattern read ${above}/_reply/%c/#`))
      })
    })
    this.listened.set(filter, subscribed)
    subscribed.catch(() => this.listened.delete(filter))
    return subscribed
  }

  take(topic, buffer, packet) {
    const text = new TextDecoder().decode(buffer)
    const data = packet.properties?.correlationData
    const token = data ? new TextDecoder().decode(data) : topic.slice(topic.lastIndexOf('/') + 1)
    const found = this.waiting.get(token)
    if (!found) return
    // Where it says that it is no error, a response may have a field of that name.
    const error = packet.properties?.userProperties?.status === 'ok' ? '' : errorIn(text)
    if (error) found.reject(new Error(error))
    else found.resolve(text)
  }

  /** Publish once: the reason code, and the words for one that refuses. Nothing is sent again. */
  async publish({ topic, payload, qos = 1, retain = false, properties = {} }) {
    await this.connected
    if (!this.client.connected) throw new Error('No connection to the robot now.')
    return new Promise((resolve, reject) => {
      this.client.publish(topic, payload, { qos, retain, properties }, (error, packet) => {
        const code = packet?.reasonCode ?? error?.code ?? 0
        if (error && !(code >= REFUSED)) reject(this.isOver ? new Error(UNKNOWN) : error)
        else resolve({ code, words: packet?.properties?.reasonString ?? error?.message ?? '' })
      })
    })
  }
}

function errorIn(text) {
  const error = valueOf(text)?.error
  return typeof error?.code === 'string' ? `${error.code}: ${error.message}` : ''
}
