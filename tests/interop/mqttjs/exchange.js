// One exchange of MQTT.js with a broker; prints what was received as one line of JSON.
// The environment variable EXCHANGE has, as JSON: what, options (for mqtt.connectAsync), topic, qos.

import process from 'node:process'
import mqtt from 'mqtt'

const { what, options, topic, qos } = JSON.parse(process.env.EXCHANGE)

/** A connected client that keeps what it receives. */
async function connect(more = {}) {
  const client = mqtt.connect({ ...options, ...more })
  const received = []
  let wake = () => {}
  client.on('message', (name, payload, packet) => {
    const { retain, dup, properties = {} } = packet
    const told = { ...properties, userProperties: { ...properties.userProperties } }
    if (properties.correlationData) told.correlationData = properties.correlationData.toString()
    if (!properties.userProperties) delete told.userProperties
    received.push({ topic: name, payload: payload.toString(), qos: packet.qos, retain, dup, properties: told })
    wake()
  })
  const connack = await new Promise((resolve, reject) => {
    client.once('connect', resolve)
    client.once('error', reject)
  })
  return {
    connack,
    subscribe: (name, subscription) => client.subscribeAsync(name, subscription),
    publish: (name, payload, publication) => client.publishAsync(name, payload, publication),
    end: () => client.endAsync(),
    /** Gone without a word. */
    kill: () => client.stream.destroy(),
    receive: async (count) => {
      while (received.length < count) await new Promise((resolve) => { wake = resolve })
      return received.splice(0, count)
    }
  }
}

const exchanges = {
  async publish() {
    const [sender, receiver] = [await connect(), await connect()]
    const granted = await receiver.subscribe(`${topic}/+`, { qos })
    for (let number = 0; number < 30; number++) {
      await sender.publish(`${topic}/a`, String(number), { qos })
    }
    const received = await receiver.receive(30)
    await Promise.all([sender.end(), receiver.end()])
    return { granted, received }
  },

  async retained() {
    const sender = await connect()
    const late = await connect()
    await sender.publish(topic, 'retained', { qos, retain: true })
    await sender.publish(`${topic}/end`, '', { qos: 1 }) // behind it
    await late.subscribe(topic, { qos })
    const received = await late.receive(1)
    // Acknowledged: of QoS 0 nobody knows when the broker has it, and Nagle's algorithm takes its time.
    await sender.publish(topic, '', { qos: Math.max(qos, 1), retain: true })
    const later = await connect()
    await later.subscribe(topic, { qos })
    await sender.publish(topic, 'live', { qos })
    received.push(...await later.receive(1))
    await Promise.all([sender.end(), late.end(), later.end()])
    return { received }
  },

  async will() {
    const watcher = await connect()
    await watcher.subscribe(`${topic}/#`, { qos })
    const will = { topic: `${topic}/will`, payload: 'gone', qos, retain: false }
    const dying = await connect({ will })
    dying.kill()
    const received = await watcher.receive(1)
    const leaving = await connect({ will })
    await leaving.end()
    await watcher.publish(`${topic}/end`, 'end', { qos })
    received.push(...await watcher.receive(1))
    await watcher.end()
    return { received }
  },

  async session() {
    const session = { clean: false, clientId: topic.replaceAll('/', '-') }
    if (options.protocolVersion === 5) session.properties = { sessionExpiryInterval: 600 }
    const first = await connect(session)
    await first.subscribe(topic, { qos })
    await first.end()
    const sender = await connect()
    for (const text of ['one', 'two']) await sender.publish(topic, text, { qos })
    const second = await connect(session)
    const received = await second.receive(2)
    await Promise.all([sender.end(), second.end()])
    const present = [first.connack.sessionPresent, second.connack.sessionPresent]
    return { present, received }
  },

  async properties() {
    const client = await connect()
    await client.subscribe(topic, { qos, properties: { subscriptionIdentifier: 7 } })
    const properties = {
      payloadFormatIndicator: true,
      messageExpiryInterval: 1000,
      contentType: 'application/json',
      responseTopic: `${topic}/answer`,
      correlationData: Buffer.from('42'),
      userProperties: { a: ['1', '2'], b: '3' }
    }
    await client.publish(topic, '{}', { qos, properties })
    const received = await client.receive(1)
    await client.end()
    return { received }
  },

  async refused() {
    return connect().then(() => ({}), (error) => ({ code: error.code, message: error.message }))
  }
}

console.log(JSON.stringify(await exchanges[what]()))
process.exit()
