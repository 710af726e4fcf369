// All routes with their figures, one of them in detail, and what is not bridged, and why.

import { h } from './vendor/preact.mjs'
import { useMemo } from './vendor/hooks.mjs'
import { signal } from './vendor/signals.mjs'
import htm from './vendor/htm.mjs'
import { robot as own, robots } from './link.js'
import { Refused, useShelf } from './calling.js'
import { counted, size } from './formats.js'
import { valueOf } from './json-text.js'

const html = htm.bind(h)

const SHOWN = 200
const FIGURES = ['rate', 'byte_rate', 'lost', 'dropped', 'throttled', 'errors', 'latency_ms']
const COUNTS = ['rate', 'byte_rate', 'size', 'messages', 'lost', 'dropped', 'throttled', 'skipped', 'errors', 'expired', 'refused']
const LIVE = [['+/_appliance/live', 1]]

const COLUMNS = [
  ['ros', 'ROS'], ['mqtt', 'MQTT'], ['type', 'Type'], ['rate', 'Hz'], ['size', 'Bytes'], ['lost', 'Lost'], ['dropped', 'Dropped'],
  ['throttled', 'Throttled'], ['errors', 'Errors'], ['p99', 'Latency, ms'],
]
const NUMBERS = new Set(['rate', 'size', 'lost', 'dropped', 'throttled', 'errors', 'p99'])
const WAYS = ['to_mqtt', 'to_ros']

const sought = signal('')
const way = signal('')
const order = signal({ by: 'ros', isDown: false })

/** What is bridged of all robots, with the figures of the last second where they have come. */
export function useRoutes() {
  const told = useShelf(LIVE)
  const live = useMemo(() => figuresOf(told.topics), [told.topics])
  const all = useMemo(() => [...robots.value].flatMap(([robot, { routes = [] }]) => routes
    .filter(({ direction }) => WAYS.includes(direction))
    .map((route) => plain({ ...route, ...live.get(robot)?.get(keyOf(route)), robot, key: keyOf(route) }))), [robots.value, live])
  return { all, told }
}

/** The route with numbers where it has figures: they may come from anybody who plays a robot. */
function plain(route) {
  for (const name of COUNTS) {
    if (!Number.isFinite(route[name])) route[name] = undefined
  }
  if (typeof route.last_error !== 'string') route.last_error = ''
  const { p50, p99 } = route.latency_ms ?? {}
  return { ...route, p50, p99: Number.isFinite(p99) ? p99 : undefined }
}

function keyOf({ direction, mqtt }) {
  return `${direction === 'to_ros' ? '<' : '>'}${mqtt}`
}

const read = new WeakMap() // what is kept of a robot → its figures, so that each is read once

/** The figures of the last second, by robot and then by route. */
function figuresOf(topics) {
  return new Map([...topics].map(([topic, entry]) => {
    if (!read.has(entry)) read.set(entry, figuresIn(entry.text))
    return [topic.slice(0, topic.indexOf('/')), read.get(entry)]
  }))
}

function figuresIn(text) {
  const found = new Map()
  const routes = valueOf(text)?.routes
  for (const route of Array.isArray(routes) ? routes : []) {
    if (typeof route?.mqtt !== 'string') continue
    found.set(keyOf(route), Object.fromEntries(FIGURES.map((name) => [name, route[name]])))
  }
  return found
}

export default function Routes({ topic: chosen }) {
  const { all, told } = useRoutes()
  const named = all.filter(({ key }) => key === chosen)
  const route = named.find(({ robot }) => robot === own) ?? named[0]
  const skipped = [...robots.value].flatMap(([, about]) => (Array.isArray(about.skipped?.skipped) ? about.skipped.skipped : []))
  return html`<h1>Routes</h1>
    <${Refused} told=${told} />
    ${chosen ? html`<${Details} route=${route} />` : html`<${List} all=${all} />
    <section aria-labelledby="skipped"><h2 id="skipped">Not bridged</h2><${NotBridged} skipped=${skipped} /></section>`}`
}

function List({ all }) {
  const words = sought.value.toLowerCase().split(/\s+/).filter(Boolean)
  const found = all.filter((route) => (!way.value || route.direction === way.value)
    && words.every((word) => `${route.ros} ${route.mqtt} ${route.type}`.toLowerCase().includes(word)))
  const { by, isDown } = order.value
  const compare = ({ [by]: one = -1 }, { [by]: other = -1 }) => (one > other) - (one < other)
  found.sort((one, other) => (isDown ? compare(other, one) : compare(one, other)))
  const sort = (name) => { order.value = { by: name, isDown: by === name ? !isDown : NUMBERS.has(name) } }
  return html`
    <div class="tools filters">
      <input type="search" aria-label="Search routes" placeholder="Search" value=${sought.value} maxlength="200"
        onInput=${(event) => { sought.value = event.currentTarget.value }} />
      <select aria-label="Direction" value=${way.value} onChange=${(event) => { way.value = event.currentTarget.value }}>
        <option value="">both ways</option><option value="to_mqtt">to MQTT</option><option value="to_ros">to ROS</option></select>
      <select class="narrow" aria-label="Sort by" value=${by} onChange=${(event) => sort(event.currentTarget.value)}>
        ${COLUMNS.map(([name, label]) => html`<option key=${name} value=${name}>by ${label}</option>`)}</select>
    </div>
    <p class="quiet" role="status">${counted(found.length, 'route')}${found.length > SHOWN ? `, the first ${SHOWN} are shown` : ''}</p>
    <table class="routes"><thead><tr>${COLUMNS.map(([name, label]) => html`
      <th key=${name} class=${NUMBERS.has(name) ? 'number' : ''} aria-sort=${by === name ? (isDown ? 'descending' : 'ascending') : null}>
        <button class="quiet" onClick=${() => sort(name)}>${label}${by === name ? (isDown ? ' ▼' : ' ▲') : ''}</button></th>`)}
    </tr></thead><tbody>${found.slice(0, SHOWN).map((route) => html`<${Row} key=${route.robot + route.key} route=${route} />`)}</tbody></table>`
}

function Row({ route }) {
  const cells = { ...route, p99: latency(route) }
  return html`<tr>
    <td data-label="ROS"><a href=${`#/routes/${encodeURIComponent(route.key)}`}><bdi>${route.ros}</bdi></a></td>
    <td data-label="MQTT">${route.direction === 'to_ros' ? '←' : '→'} <bdi>${route.mqtt}</bdi></td>
    <td data-label="Type"><bdi>${route.type}</bdi></td>
    ${COLUMNS.slice(3).map(([name, label]) => html`<td key=${name} data-label=${label}
      class=${`number ${BAD.has(name) && cells[name] > 0 ? 'bad' : ''}`}>${shown(cells[name])}</td>`)}
  </tr>${route.last_error && html`<tr class="why"><td colspan=${COLUMNS.length} class="bad"><bdi>${route.last_error}</bdi></td></tr>`}`
}

const BAD = new Set(['lost', 'dropped', 'errors'])

function shown(value) {
  return typeof value === 'number' || typeof value === 'string' ? value : '–'
}

function latency({ p50, p99 }) {
  return typeof p50 === 'number' && p99 !== undefined ? `${p50} / ${p99}` : null
}

function Details({ route }) {
  if (!route) return html`<p class="notice">This route is not bridged now. <a href="#/routes">All routes</a></p>`
  const isToRos = route.direction === 'to_ros'
  const link = encodeURIComponent(route.mqtt)
  return html`<section class="inspector" aria-labelledby="route">
    <div class="tools"><h2 id="route"><bdi>${route.ros}</bdi> ${isToRos ? '←' : '→'} <bdi>${route.mqtt}</bdi></h2>
      <a class="button" href="#/routes">Close</a></div>
    <div class="tools"><a class="button" href=${`#/topics/${link}`}>Inspect</a>
      ${isToRos && html`<a class="button" href=${`#/publish/${link}`}>Publish</a>`}</div>
    ${route.last_error && html`<p class="notice bad"><bdi>${route.last_error}</bdi></p>`}
    <dl class="properties">${[...factsOf(route), ...(isToRos ? rulesOf(route.rules) : [])].map(([name, value]) => html`
      <div key=${name}><dt>${name}</dt><dd><bdi>${shown(value)}</bdi></dd></div>`)}</dl>
  </section>`
}

function factsOf(route) {
  const ofRos = 'as ROS has it'
  const towards = route.direction === 'to_ros' ? [] : [
    ['QoS', route.qos ?? ofRos],
    ['retain', route.retain == null ? ofRos : route.retain ? 'yes' : 'no'],
    ['most a second', route.max_rate ?? 'no limit'],
  ]
  return [
    ['type', route.type], ['encoding', route.encoding], ...towards,
    ['messages', route.messages], ['a second', `${shown(route.rate)}${route.byte_rate >= 0 ? `, ${size(route.byte_rate)}` : ''}`],
    ['mean size', `${shown(route.size)} B`],
    ['latency, median / 99 %', latency(route) ? `${latency(route)} ms` : 'not measured'],
    ...['lost', 'dropped', 'throttled', 'skipped', 'errors', 'expired', 'refused'].map((name) => [name, shown(route[name])]),
  ]
}

function rulesOf(rules) {
  if (rules === null || typeof rules !== 'object') return [['rules for commands', 'none']]
  const clamp = rules.clamp !== null && typeof rules.clamp === 'object' ? Object.entries(rules.clamp) : []
  return [
    ['expire', rules.expire == null ? 'never' : `${shown(rules.expire)} s`],
    ['on silence', rules.on_silence == null ? 'nothing' : `the stop message after ${shown(rules.on_silence)} s`],
    ['exclusive', rules.exclusive ? `one client at a time, lease ${shown(rules.lease)} s` : 'no'],
    ['commanding', rules.commanding ?? 'nobody'],
    ...clamp.slice(0, 100).map(([field, range]) => [`clamp ${field}`, Array.isArray(range) ? range.slice(0, 2).map(shown).join(' to ') : '–']),
  ]
}

function NotBridged({ skipped }) {
  if (skipped.length === 0) return html`<p class="good">Nothing is left out.</p>`
  return html`<ul class="warnings">${skipped.slice(0, 100).map((each, index) => html`<li key=${index}>
    <strong><bdi>${shown(each?.ros)}</bdi></strong> <bdi>${shown(each?.type || each?.direction)}</bdi>: ${shown(each?.reason)}</li>`)}</ul>`
}
