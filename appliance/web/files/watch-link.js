// The connection of a page that watches a few topics, each at a rate of its own.

export const PACKET = 17 * 1024 * 1024 // a picture has at most 16 MiB

const REFUSED = new Set([0x86, 0x87, 0x8a]) // bad user name or password, not authorized, banned

export class Watch {
  /** Each of `wanted` is [topic, messages a second, 0 for all]; `take` gets each message, and keeps what it wants. */
  constructor(open, wanted, take) {
    this.reason = ''
    this.isOver = false
    this.isNews = true
    this.wake = () => {}
    const client = open({}, PACKET)
    this.client = client
    const say = (reason) => {
      if (this.isOver || reason === this.reason) return
      this.reason = reason
      this.tell()
    }
    client.on('connect', () => {
      say('')
      for (const [topic, rate] of wanted) {
        const properties = rate ? { userProperties: { 'max-rate': String(rate) } } : {}
        client.subscribe(topic, { qos: 0, properties }, (error, granted, packet) => {
          const code = packet?.granted?.[0] ?? 0 // without a packet the connection was lost
          if (code >= 0x80) say(refusal(topic, code))
        })
      }
    })
    client.on('message', (topic, buffer, packet) => {
      // A copy: the buffer is a view of all that has come with it.
      if (this.isOver) return
      take(topic, new Uint8Array(buffer), packet.properties ?? {}, Date.now())
      this.tell()
    })
    client.on('error', (error) => {
      if (!REFUSED.has(error.code)) return
      say(`The login was refused: ${error.message}`)
      client.end(true) // asking again and again would only count as wrong passwords
    })
    client.on('close', () => { if (!this.reason) say('The connection is lost; trying again.') })
  }

  stop() {
    this.isOver = true
    this.client.end(true)
    this.tell()
  }

  tell() {
    this.isNews = true
    this.wake()
  }

  /** Wait until a message has come, or `reason` is another one. False when it is over. */
  async news() {
    while (!this.isNews && !this.isOver) await new Promise((resolve) => { this.wake = resolve })
    this.isNews = false
    return !this.isOver
  }
}

function refusal(topic, code) {
  if (code !== 0x87) return `The subscription was refused (0x${code.toString(16)}).`
  return `This user may not read this topic. The access rules would need the line: topic read ${topic}`
}
