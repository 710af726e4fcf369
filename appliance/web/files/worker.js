// The connections, away from the page, which is handed what has changed when it asks, once a frame.
// The password is in this memory only. A token stands for it at each login but the first, and the
// page keeps that for when it is loaded again.

import mqtt from './vendor/mqtt.esm.js'
import { About } from './about.js'
import { Drive } from './drive-link.js'
import { Focus } from './focus.js'
import { Newest } from './newest.js'
import { Shelf } from './shelf.js'

const SURVEY_PACKET = 32 * 1024
const FOCUS_PACKET = 12 * 1024 * 1024
const MAX_RATE = '2' // messages a second of each topic in the survey
const TOKEN = 'appliance-token-' // what each begins with
// In the client ids of this window: who sees a list of clients sees which belong together.
// How they end cannot be guessed either: somebody else might have taken the next one.
const WINDOW = random()
const NAME = 32 // characters of the user's name in them
const LEAVING = 3000 // ms for the token's end; then the page goes
const WRONG = [0x86, 0x87] // reason codes of a login that is not accepted
const LATER = [0x88, 0x89, 0x97, 0x9f] // and of one that may be, with the same password, after a while
const NO_ROOM = 'The robot has no room now; trying again.'

let login = null
let survey = null
let focus = null
let drive = null
let shelf = null
let shelved = { run: 0, wanted: [] } // what the open page wants kept
let desk = null // the connection for calls, once somebody calls
let state = { name: 'out', reason: '' }
let newest = new Newest()
let about = null // what robots say of their bridges

function random() {
  return crypto.getRandomValues(new Uint32Array(1))[0].toString(36)
}

/** A client id, which is read where it drives: whose it is, of the letters that no rule of access minds. */
function clientId() {
  const name = [...(login.user ?? '')].filter((letter) => /[\p{L}\p{N}._-]/u.test(letter))
  return ['console', name.slice(0, NAME).join(''), WINDOW, random()].filter(Boolean).join('-')
}

function options(more, packet) {
  return {
    protocolVersion: 5,
    clientId: clientId(),
    username: login.user,
    // At each connect, as a client that reconnects keeps what it was made with.
    transformWsUrl: (url, _, client) => {
      client.options.password = login?.token ?? login?.password
      return url
    },
    clean: true,
    keepalive: 15,
    connectTimeout: 10000,
    reconnectPeriod: 1000,
    reconnectOnConnackError: true, // a token may have ended, and there may be no room for a while
    resubscribe: false,
    queueQoSZero: false,
    timerVariant: 'native',
    properties: { maximumPacketSize: packet, sessionExpiryInterval: 0 },
    ...more,
  }
}

export function open(more, packet) {
  const client = mqtt.connect(login.url, options(more, packet))
  client.on('error', ({ code }) => {
    if (!WRONG.includes(code)) return
    if (!client.options.password?.startsWith(TOKEN)) {
      client.end(true) // asking again and again would only count as wrong passwords
      return
    }
    if (login?.token === client.options.password) tokenHasEnded()
    // With the password, and without a pause: it is the robot's computer that has started again.
    if (login !== null && client.options.reconnectPeriod) setTimeout(() => client.reconnect())
  })
  return client
}

/** With its time, another password, or the robot's computer: the password gets another one. */
function tokenHasEnded() {
  login.token = null
  if (login.password === undefined) {
    end({ name: 'refused', reason: 'You were signed out. Sign in again.' })
  } else if (survey?.connected) {
    stay()
  }
}

/** Get a token. Without the right to that, the page asks for the password when it is loaded again. */
async function stay() {
  const { password } = login
  const mine = login
  try {
    const { token } = JSON.parse(await callVerb('token', { password }))
    mine.token = token
  } catch {
    // The password does as well.
  }
}

async function callVerb(name, values) {
  const topic = `$CONTROL/appliance/v1/${name}/_call`
  return (await calling()).request({ topic, payload: JSON.stringify(values) })
}

function subscribe(client, filters, rate) {
  const properties = rate ? { userProperties: { 'max-rate': rate } } : {}
  return new Promise((resolve) => {
    client.subscribe(filters, { qos: 0, properties }, (error, granted, packet) => {
      resolve(packet?.granted ?? []) // without a packet the connection was lost
    })
  })
}

function signIn({ url, user, password, token, robot }) {
  signOut()
  login = { url, user, password, token }
  about = new About(robot)
  state = { name: 'connecting', reason: '' }
  const client = open({}, SURVEY_PACKET)
  survey = client
  client.on('connect', async () => {
    if (client !== survey) return
    state = { name: 'in', reason: '' }
    focus ??= new Focus(() => open({}, FOCUS_PACKET), about)
    if (shelf === null) {
      shelf = new Shelf(focus.client)
      shelf.look(shelved)
    }
    drive ??= new Drive((more) => open(more, SURVEY_PACKET))
    drive.again()
    if (!login.token) stay()
    const granted = await subscribe(client, ['#', '$SYS/#'], MAX_RATE)
    if (client === survey && granted[0] >= 0x80) state.reason = 'This user may read no topic.'
  })
  client.on('message', (topic, buffer, packet) => newest.take(topic, buffer, packet))
  client.on('error', (error) => {
    if (client !== survey) return
    const code = error.code
    const isRefused = typeof code === 'number' && code > 0
    if (LATER.includes(code) && (state.name === 'lost' || login.password === undefined)) {
      if (state.name === 'connecting') state.reason = NO_ROOM
    } else if (isRefused && state.name !== 'in') {
      const bad = WRONG.includes(code)
      if (bad && client.options.password !== login.password) return // it tries with the password
      end({ name: 'refused', reason: bad ? 'User name or password is wrong.' : String(error.message) })
    } else if (state.name === 'connecting') {
      state.reason = String(error.message)
    }
  })
  client.on('close', () => {
    if (client !== survey) return
    if (state.name === 'in') state = { name: 'lost', reason: 'The connection is lost; trying again.' }
    else if (state.name === 'connecting' && state.reason !== NO_ROOM) end({ name: 'failed', reason: 'No connection.' })
  })
}

function end(reason) {
  signOut()
  state = reason
}

function signOut() {
  unwatch()
  for (const each of [focus, drive, shelf]) each?.stop()
  desk?.stop()
  survey?.end(true)
  survey = focus = drive = shelf = desk = login = about = null
  newest = new Newest()
  state = { name: 'out', reason: '' }
}

/** Sign out for good: the token ends too, over a connection that outlives the others. */
async function leave() {
  const token = login?.token
  const last = token ? await calling().catch(() => null) : null
  desk = null
  signOut()
  if (last === null) return
  const values = { topic: '$CONTROL/appliance/v1/token_end/_call', payload: JSON.stringify({ token }), timeout: LEAVING }
  await last.request(values).catch(() => {})
  last.stop()
}

// --- what a page watches: pictures or a map, over a connection that ends with the page -----------

const VIEWERS = { camera: () => import('./camera-link.js'), map: () => import('./map-link.js') }

let viewer = null
let watching = 0

async function watch({ kind, ...what }) {
  unwatch()
  const asked = watching
  const { default: Viewer } = await VIEWERS[kind]()
  if (asked === watching && login !== null) viewer = new Viewer(open, what)
}

function unwatch() {
  watching += 1
  viewer?.stop()
  viewer = null
}

// -------------------------------------------------------------------------------------------------

setInterval(() => newest.measure(), 1000)

const SOON = 30 // ms that a frame waits for what takes a file to be loaded, or a picture to be decoded
const asked = new WeakMap() // focus or shelf → the promise of its answer
const answered = new WeakMap() // focus or shelf → its answer, which no frame has taken yet

/** What a part has told since it was asked last; null while that is not known. */
async function soon(part) {
  if (part === null) return null
  if (!asked.has(part) && !answered.has(part)) {
    asked.set(part, part.told().then((told) => answered.set(part, told), () => {}).finally(() => asked.delete(part)))
  }
  await Promise.race([asked.get(part), new Promise((resolve) => { setTimeout(resolve, SOON) })])
  const told = answered.get(part) ?? null
  answered.delete(part)
  return told
}

async function frame() {
  const told = { focus: await soon(focus), shelf: await soon(shelf) }
  told.rows = newest.rows()
  told.untold = newest.untold
  told.about = about?.told() ?? []
  told.drive = drive?.told() ?? null
  return { ...told, state, token: login?.token ?? null }
}

/** The connection for calls, with its module: most visitors never need it. */
async function calling() {
  const { Calls } = await import('./calls-link.js')
  if (login === null) throw new Error('Nobody is signed in.')
  if (desk === null || desk.isOver) desk = new Calls(open)
  return desk
}

const calls = {
  signIn,
  signOut: leave,
  frame,
  focus: ({ topic }) => focus?.look(topic, newest.whole(topic)),
  plot: ({ path }) => focus?.plot(path),
  show: ({ index }) => focus?.show(index),
  pause: ({ paused }) => focus?.pause(paused),
  export: () => focus?.export(),
  ready: ({ route }) => drive?.prepare(route),
  go: ({ linear, angular }) => drive?.go(linear, angular),
  stop: () => drive?.release(),
  leave: () => drive?.leave(),
  watch,
  unwatch,
  next: () => viewer?.next(),
  shelve: (values) => {
    shelved = values
    shelf?.look(values)
  },
  request: async (values) => (await calling()).request(values),
  publish: async (values) => (await calling()).publish(values),
}

self.onmessage = async ({ data: { number, call, values } }) => {
  try {
    const answer = (await calls[call](values ?? {})) ?? null
    const pictures = [answer?.bitmap, answer?.focus?.bitmap].filter(Boolean)
    self.postMessage({ number, answer }, pictures)
  } catch (error) {
    self.postMessage({ number, error: String(error?.message ?? error) })
  }
}
