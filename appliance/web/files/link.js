// The page's side of the worker: what it has told, as signals that the parts of the page follow.

import { batch, signal } from './vendor/signals-core.mjs'

const FRAME = 100 // ms between two questions; the values change twice a second

const STORED = 'console' // what this window keeps of a sign-in: the user and a token, no password

export const session = signal({ name: 'out', reason: history.state?.reason ?? '' })
history.replaceState(null, '')
export const user = signal('')
export const rows = new Map() // topic → signal of its row
export const names = signal([]) // all topics, sorted
export const untold = signal(0)
/** The name of this robot, as its server says. Others' topics may be anybody's. */
export const robot = document.querySelector('meta[name=robot]').content
export const robots = signal(new Map()) // robot → {routes, skipped}
/**
 * All routes, with `robot`, whose they are: this robot's first. Others' topics may be anybody's, so that what
 * they say of a topic of this robot, or of one that another robot has named before, does not count.
 */
export function allRoutes() {
  const named = new Map() // topic → whose
  const found = []
  const add = (name) => {
    for (const route of robots.value.get(name)?.routes ?? []) {
      if ((named.get(route.mqtt) ?? name) !== name) continue
      named.set(route.mqtt, name)
      found.push({ ...route, robot: name })
    }
  }
  add(robot)
  for (const name of robots.value.keys()) if (name !== robot) add(name)
  return found
}

export const inspected = signal(null)
export const drive = signal(null)
/** What is kept for the open page: topics with {text, isJson, size, rate, at}, and filters that were refused. */
export const shelf = signal({ topics: new Map(), refused: [] })
export const isPaused = signal(false)

let worker = null
let number = 0
const waiting = new Map()

export function ask(call, values) {
  if (worker === null) start()
  number += 1
  const asked = new Promise((resolve, reject) => waiting.set(number, { resolve, reject }))
  worker.postMessage({ number, call, values })
  return asked
}

/** Tell without an answer that anybody waits for. */
export function tell(call, values) {
  ask(call, values).catch(() => {})
}

function start() {
  worker = new Worker(new URL('./worker.js', import.meta.url), { type: 'module' })
  let isLoaded = false
  worker.onmessage = ({ data }) => {
    isLoaded = true
    const found = waiting.get(data.number)
    waiting.delete(data.number)
    if (data.error === undefined) found?.resolve(data.answer)
    else found?.reject(new Error(data.error))
  }
  worker.onerror = () => {
    if (!isLoaded) notLoaded() // later ones are in the browser's log
  }
  requestAnimationFrame(frame)
}

/** Whoever signs in next loads it again. */
function notLoaded() {
  const reason = 'The connection’s program could not be loaded.'
  session.value = { name: 'failed', reason }
  worker = null
  for (const { reject } of waiting.values()) reject(new Error(reason))
  waiting.clear()
}

let asked = 0

/** One question at a time, and none while the page is hidden: the browser draws no frames then. */
async function frame(now) {
  if (worker === null) return
  if (now - asked < FRAME) {
    requestAnimationFrame(frame)
    return
  }
  asked = now
  try {
    take(await ask('frame'))
  } finally {
    requestAnimationFrame(frame)
  }
}

function take(told) {
  const old = session.peek()
  if (old.name === 'leaving') return
  if (told.state.name === 'refused') {
    keep(null)
    if (old.name === 'in' || old.name === 'lost') {
      leave(told.state.reason)
      return
    }
  }
  batch(() => {
    if (old.name !== told.state.name || old.reason !== told.state.reason) session.value = told.state
    drive.value = told.drive
    if (told.about.length) takeAbout(told.about)
    if (told.token !== null && user.peek()) keep(told.token)
    if (untold.peek() !== told.untold) untold.value = told.untold
    if (!isPaused.peek()) takeRows(told.rows)
    else for (const row of told.rows) held.set(row[0], row)
    if (told.shelf?.run === shelving) takeShelf(told.shelf)
    if (told.focus) {
      inspected.peek()?.bitmap?.close()
      inspected.value = told.focus
    }
  })
}

function takeAbout(told) {
  const found = new Map(robots.peek())
  for (const [robot, what, value] of told) {
    const about = { ...found.get(robot), [what]: value }
    if (about.routes === undefined && about.skipped === undefined) found.delete(robot)
    else found.set(robot, about)
  }
  robots.value = found
}

const NAMES_PERIOD = 500 // ms between two times that a page goes through all names

const fresh = [] // names that are not among the others yet
let named = 0

const held = new Map() // topic → its newest row, of those that came while the page was paused

export function pause(paused) {
  isPaused.value = paused
  tell('pause', { paused })
  if (paused) return
  batch(() => takeRows([...held.values()]))
  held.clear()
}

function takeRows(told) {
  for (const [topic, text, size, rate, at, retain] of told) {
    const row = { text, size, rate, at, retain }
    const known = rows.get(topic)
    if (known) known.value = row
    else {
      rows.set(topic, signal(row))
      fresh.push(topic)
    }
  }
  if (fresh.length === 0 || performance.now() - named < NAMES_PERIOD) return
  names.value = [...names.peek(), ...fresh.splice(0)].sort() // nearly sorted: that is quick
  named = performance.now()
}

/** Load the page anew: whoever signs in next finds nothing of this user in its memory. */
function leave(reason) {
  session.value = { name: 'leaving', reason }
  worker.terminate()
  history.replaceState({ reason }, '', location.pathname)
  location.reload()
}

export function focus(topic) {
  inspected.value = null
  tell('focus', { topic })
}

let shelving = 0

/** Keep the newest of these in `shelf`: pairs of a filter and messages a second. */
export function shelve(wanted) {
  shelving += 1
  shelf.value = { topics: new Map(), refused: [] }
  tell('shelve', { run: shelving, wanted })
}

function takeShelf({ changes, refused }) {
  const old = shelf.peek()
  if (changes.length === 0 && refused.length === old.refused.length) return
  const topics = new Map(old.topics)
  for (const [topic, entry] of changes) {
    if (entry === null) topics.delete(topic)
    else topics.set(topic, entry)
  }
  shelf.value = { topics, refused }
}

/** The answer to a call of a service, an action or a verb, as text. Rejects with its error. */
export function request(topic, payload, timeout) {
  return ask('request', { topic, payload, timeout })
}

/** What a verb of the appliance's management answers (docs/management.md). */
export async function verb(name, values = {}, timeout = undefined) {
  return JSON.parse(await request(`$CONTROL/appliance/v1/${name}/_call`, JSON.stringify(values), timeout))
}

/** Sign in with a password, or with the token of a page before this one. */
export function signIn(name, password, token) {
  const url = `${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/mqtt`
  if (token === undefined) keep(null) // one of somebody else, who was not signed out
  user.value = name
  session.value = { name: 'connecting', reason: '' }
  return ask('signIn', { url, user: name, password, token, robot })
}

/** Sign in again after the page was loaded again. */
export function resume() {
  try {
    const { name, token } = JSON.parse(sessionStorage.getItem(STORED)) ?? {}
    if (typeof name !== 'string' || typeof token !== 'string') return
    kept = token
    signIn(name, undefined, token).catch(() => {})
  } catch {
    // The browser stores nothing, or what is there is not ours.
  }
}

let kept = null

function keep(token) {
  if (token === kept) return
  kept = token
  try {
    if (token === null) sessionStorage.removeItem(STORED)
    else sessionStorage.setItem(STORED, JSON.stringify({ name: user.peek(), token }))
  } catch {
    // The browser stores nothing: the page asks for the password when it is loaded again.
  }
}

export async function signOut() {
  session.value = { name: 'leaving', reason: '' }
  keep(null)
  await ask('signOut').catch(() => {})
  leave('')
}
