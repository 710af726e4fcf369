// The connection that drives. Nothing is queued and nothing is sent again: what has not gone out is
// given up, and the connection ends with each release.

const PERIOD = 50 // ms; the appliance carries a stream of 10 Hz or more
const PAGE_PATIENCE = 300 // ms without a word of the page: its thread hangs
const UNANSWERED = 4 // commands on their way; more wait for no one
const GOODBYE = 1000 // ms for the acknowledgement of the stop message
const BEGINS = 'a stream is carried out from its third command on' // the bridge's word for what is usual

export class Drive {
  constructor(open) {
    this.open = open
    this.route = null
    this.client = null
    this.parting = null // the connection before, until its stop message is acknowledged
    this.driver = '' // the client id of the connection that drove last
    this.timer = null
    this.mustLetGo = false // the connection was lost while it drove
    this.state = 'idle'
    this.reason = ''
    this.sent = this.refused = 0
  }

  stop() {
    this.leave()
  }

  /** Connect for a route, so that the first command need not wait for the login. */
  prepare(route) {
    const isSame = this.route?.mqtt === route.mqtt && this.route.isStamped === route.isStamped
    if (this.client !== null && isSame) return
    this.leave()
    this.route = route
    this.connect()
  }

  /** Connect after the connection was lost, and command nothing. */
  again() {
    if (this.client === null && this.route !== null && this.timer === null) this.connect()
  }

  connect() {
    this.state = 'connecting'
    const client = this.open({ reconnectPeriod: 0, keepalive: 2 })
    this.client = client
    this.unanswered = 0
    client.on('connect', () => {
      if (client === this.client) this.state = 'ready'
    })
    client.on('error', (error) => {
      if (client === this.client) this.reason = String(error.message)
    })
    client.on('close', () => {
      if (client !== this.client) return
      if (this.timer !== null) {
        this.mustLetGo = true
        this.reason = `${this.reason || 'The connection was lost'}: let go, and hold again.`
      }
      this.halt()
      this.client = null
      this.state = 'lost'
    })
  }

  go(linear, angular) {
    if (this.mustLetGo) return // it has stopped: nothing moves it again but another press
    this.wanted = [linear, angular]
    this.heard = [Date.now(), performance.now()]
    this.again()
    if (this.timer !== null) return
    this.reason = ''
    this.timer = setInterval(() => this.command(), PERIOD)
    this.command()
  }

  command() {
    // One clock counts while a device sleeps, the other one is never set.
    if (Math.max(Date.now() - this.heard[0], performance.now() - this.heard[1]) > PAGE_PATIENCE) {
      this.release()
      this.reason = 'The page did not answer; stopped.'
      return
    }
    // The connection before commands until it has gone: of two, one would be refused.
    if (!this.client?.connected || this.parting !== null || this.unanswered >= UNANSWERED) return
    this.state = 'driving'
    this.driver = this.client.options.clientId
    this.publish(...this.wanted)
  }

  publish(linear, angular) {
    const twist = { linear: { x: linear, y: 0, z: 0 }, angular: { x: 0, y: 0, z: angular } }
    const command = this.route.isStamped ? { header: { stamp: 'now' }, twist } : twist
    const client = this.client
    this.unanswered += 1
    this.sent += 1
    client.publish(
      this.route.mqtt,
      JSON.stringify(command),
      { qos: 1, properties: { contentType: 'application/json' } },
      (error, packet) => {
        if (client === this.client) this.unanswered -= 1
        if (!error && this.timer !== null) this.reason = ''
        const code = packet?.reasonCode ?? error?.code ?? 0
        const words = packet?.properties?.reasonString
        // The first two of each connection may be old, for all that the bridge knows.
        if (error && code >= 0x80 && !words?.includes(BEGINS)) {
          this.refused += 1
          if (words) this.reason = words
          else if (code === 0x87) {
            this.reason = 'Not authorized: another client commands, or no access rule lets this user '
              + `write ${this.route?.mqtt}.`
          } else this.reason = error.message
        }
      },
    )
  }

  halt() {
    clearInterval(this.timer)
    this.timer = null
  }

  /** Zero, then DISCONNECT: the appliance stops the robot for either of them. */
  release() {
    if (this.mustLetGo) {
      this.mustLetGo = false
      this.reason = ''
      this.again()
    }
    if (this.timer === null) return
    this.halt()
    const client = this.client
    if (client?.connected) {
      this.publish(0, 0)
      this.goodbye(client)
    } else {
      client?.end(true)
    }
    this.client = null
    this.connect()
  }

  goodbye(client) {
    this.parting = client
    const parted = () => {
      clearTimeout(late)
      if (this.parting === client) this.parting = null
    }
    const late = setTimeout(() => {
      client.end(true)
      parted()
    }, GOODBYE)
    client.end(false, {}, parted)
  }

  leave() {
    if (this.timer !== null && this.client?.connected) this.publish(0, 0)
    this.halt()
    if (this.mustLetGo) this.reason = ''
    this.mustLetGo = false
    const client = this.client
    this.client = null
    this.route = null
    this.state = 'idle'
    if (client?.connected) this.goodbye(client)
    else client?.end(true)
  }

  told() {
    const { state, reason, sent, refused, driver } = this
    return { state, reason, sent, refused, driver }
  }
}
