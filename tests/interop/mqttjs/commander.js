// A client with the defaults of MQTT.js that commands when it is told to: see ros/commander.py.
//
//     node commander.js HOST PORT VERSION QOS USER PASSWORD INDEX

import process from 'node:process'
import readline from 'node:readline'
import mqtt from 'mqtt'

const [host, port, version, qos, username, password, index] = process.argv.slice(2)
const say = (word) => process.stdout.write(`${word}\n`)
const monotonic = () => Number(process.hrtime.bigint()) / 1e9

let client
let number = 0

const commander = {
  connect(...then) {
    client = mqtt.connect({ host, port: Number(port), protocolVersion: Number(version), username, password })
    client.on('error', () => {}) // it tries again
    client.on('connect', () => {
      if (then.length) commander.drive(...then.splice(0))
      say('connected')
    })
  },

  drive(count, rate) {
    const begun = monotonic()
    const next = (sent) => {
      if (sent === count) return say('done')
      const linear = { x: ++number, y: monotonic(), z: Number(index) }
      client.publish('r2d2/cmd_vel', JSON.stringify({ linear }), { qos: Number(qos) })
      setTimeout(next, Math.max(0, 1000 * (begun + (sent + 1) / rate - monotonic())), sent + 1)
    }
    next(0)
  },

  leave: () => client.end()
}

const lines = readline.createInterface({ input: process.stdin })
lines.on('line', (line) => {
  const [name, ...rest] = JSON.parse(line)
  commander[name](...rest)
})
lines.on('close', () => process.exit(0))
