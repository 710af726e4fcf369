// node driving.js URL-of-the-console's-files: whatever becomes of the connection, only another press drives again.

import assert from 'node:assert/strict'
import { EventEmitter } from 'node:events'

const { Drive } = await import(`${process.argv[2]}/drive-link.js`)

const clients = []
const sent = []
function open(options) {
  const client = Object.assign(new EventEmitter(), { options: { ...options, clientId: `c${clients.length}` }, connected: false })
  client.publish = (topic, text, how, done) => {
    sent.push(JSON.parse(text))
    done(null, { reasonCode: 0 })
  }
  client.end = (isForced, options, done) => {
    client.connected = false
    done?.()
  }
  clients.push(client)
  return client
}
const connect = (client) => {
  client.connected = true
  client.emit('connect')
}
const lose = (client) => {
  client.connected = false
  client.emit('close')
}

const drive = new Drive(open)
drive.prepare({ mqtt: 'r/cmd_vel', isStamped: false })
connect(clients.at(-1))
drive.go(1, 0)
assert.deepEqual([sent.length, sent[0].linear.x, drive.state], [1, 1, 'driving'])

// It is lost while a button is held: nothing moves, however often the page says go, and when it is back.
lose(clients.at(-1))
for (let turn = 0; turn < 100; turn += 1) drive.go(1, 0)
assert.deepEqual([clients.length, sent.length, drive.state], [1, 1, 'lost'])
assert.equal(drive.reason, 'The connection was lost: let go, and hold again.')
drive.again()
connect(clients.at(-1))
drive.go(1, 0)
assert.deepEqual([clients.length, sent.length, drive.state], [2, 1, 'ready'])
drive.release()
assert.deepEqual([drive.reason, clients.length], ['', 2])
drive.go(1, 0)
assert.equal(sent.length, 2)
drive.release()
assert.deepEqual(sent.at(-1).linear.x, 0)

// Who has left the page has let go, and is told nothing of it.
drive.prepare({ mqtt: 'r/cmd_vel', isStamped: false })
connect(clients.at(-1))
drive.go(1, 0)
lose(clients.at(-1))
drive.leave()
assert.equal(drive.reason, '')
drive.prepare({ mqtt: 'r/cmd_vel', isStamped: false })

// Where the login is refused, each press asks once.
const before = clients.length
for (let press = 0; press < 3; press += 1) {
  for (let turn = 0; turn < 50; turn += 1) {
    drive.go(1, 0)
    if (drive.client !== null) lose(clients.at(-1))
  }
  drive.release()
}
assert.ok(clients.length - before <= 4, `${clients.length - before} logins`)

// The same topic as another type is another route.
drive.prepare({ mqtt: 'r/cmd_vel', isStamped: true })
connect(clients.at(-1))
drive.go(1, 0)
assert.equal(sent.at(-1).twist.linear.x, 1)
drive.leave()

console.log('ok')
process.exit()
