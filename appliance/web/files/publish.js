// Publish once: a form from the schema of the route's type and the JSON beside it, both in step.
// What is sent is the text as it stands, so that no number goes through a float.

import { h } from './vendor/preact.mjs'
import { useState } from './vendor/hooks.mjs'
import htm from './vendor/htm.mjs'
import { allRoutes, ask } from './link.js'
import { lack, Lacking, schemaOf, useRights, useShelf } from './calling.js'
import { Editor, mayBeSent, useMessage, withoutEnter } from './editor.js'

const html = htm.bind(h)

const LARGEST = 1024 * 1024 // characters of a payload
const CHOICES = 500 // routes to choose from

const FORMATS = { json: 'application/json', cbor: 'application/cbor', text: 'text/plain', base64: '' }
const WRITTEN = { json: 'JSON', cbor: 'JSON, sent as CBOR', text: 'Text', base64: 'Base64' }
const isJson = (format) => format === 'json' || format === 'cbor'

const ANSWERS = {
  0x00: 'Accepted', 0x10: 'Accepted; nobody has subscribed to this topic', 0x80: 'Unspecified error', 0x83: 'Implementation specific error',
  0x87: 'Not authorized', 0x90: 'Topic name invalid', 0x97: 'Quota exceeded', 0x99: 'Payload format invalid',
}

/** The routes of topics of all robots, those to ROS first. */
function routesOf() {
  const found = allRoutes()
    .filter(({ direction, encoding }) => ['to_ros', 'to_mqtt'].includes(direction) && typeof encoding === 'string')
  return found.sort((one, other) => (other.direction === 'to_ros') - (one.direction === 'to_ros'))
}

export default function Publish({ topic }) {
  const routes = routesOf()
  const go = (name) => { location.hash = `#/publish/${encodeURIComponent(name)}` }
  const open = (event) => {
    event.preventDefault()
    go(event.currentTarget.elements.topic.value)
  }
  const toRos = routes.filter(({ direction }) => direction === 'to_ros').slice(0, CHOICES)
  return html`<h1>Publish</h1>
    <div class="chosen">
      <label>Route to ROS <select value=${topic} onChange=${(event) => event.currentTarget.value && go(event.currentTarget.value)}>
        <option value="">${toRos.length ? 'Choose one' : 'None is known'}</option>
        ${toRos.map(({ mqtt, type }) => html`<option key=${mqtt} value=${mqtt}>${mqtt} (${type})</option>`)}</select></label>
      <form class="tools" onSubmit=${open}><input name="topic" aria-label="Topic" placeholder="or any topic" autocapitalize="none"
        spellcheck=${false} required maxlength="65535" pattern="[^+#]*"
        title="The name of a topic, without wildcards (+ and #)" defaultValue=${topic} key=${topic} /><button class="plain">Open</button></form>
    </div>
    ${topic && html`<${Message} key=${topic} topic=${topic} route=${routes.find(({ mqtt }) => mqtt === topic)} />`}`
}

/** How a route's payload is written here: JSON (which `cbor` is made of), text, or bytes as base64. */
function formatOf({ encoding }) {
  return ['json', 'cbor', 'text'].includes(encoding) ? encoding : 'base64'
}

function Message({ topic, route }) {
  const schemaTopic = route && isJson(formatOf(route)) ? schemaOf(route, '') : null
  const told = useShelf(schemaTopic ? [[schemaTopic, 1]] : [])
  const schema = schemaTopic ? told.topics.get(schemaTopic) : undefined
  const line = lack(useRights([topic]), topic)
  const [chosen, setFormat] = useState('json')
  const format = route ? formatOf(route) : chosen
  const [text, setText] = useState(null)
  const [answer, setAnswer] = useState(null)
  const [isBusy, setBusy] = useState(false)
  const payload = text ?? (isJson(format) ? '{}' : '')
  const message = useMessage(payload, schema, answer?.refused, isJson(format))
  const edit = (next) => {
    setText(next)
    setAnswer(null)
  }
  const submit = async (event) => {
    event.preventDefault()
    const form = event.currentTarget
    if (!mayBeSent(message, answer?.refused, form)) return
    setBusy(true)
    try {
      setAnswer(await publish(topic, route, format, await payloadOf(format, payload, message), form.elements))
    } catch (error) {
      setAnswer({ words: error.message, isBad: true })
    }
    setBusy(false)
  }
  return html`<form class="publish" onSubmit=${submit} onKeyDown=${withoutEnter}>
    <h2><bdi>${topic.slice(0, 200)}</bdi></h2>
    <${About} route=${route} format=${format} schema=${schema} root=${message.root} refused=${told.refused} />
    ${!route && html`<label>Format <select value=${chosen} onChange=${(event) => { setFormat(event.currentTarget.value); edit(null) }}>
      <option value="json">JSON</option><option value="cbor">CBOR, from JSON</option><option value="text">Text</option><option value="base64">Bytes, as base64</option></select></label>`}
    <${Editor} label=${WRITTEN[format]} text=${payload} message=${message}
      most=${LARGEST} edit=${edit} />
    <${Options} />
    <${Lacking} line=${line} what="publish here" />
    <div class="tools"><button disabled=${Boolean(line) || isBusy}>${isBusy ? 'Waiting …' : 'Publish'}</button>
      <button type="button" onClick=${() => edit(null)}>Start again</button></div>
    <div role="status">${answer && html`<p class=${`notice ${answer.isBad ? 'bad' : ''}`}>${answer.words}</p>`}</div>
  </form>`
}

function About({ route, format, schema, root, refused }) {
  if (!route) return html`<p class="quiet">No route of the bridge has this topic.</p>`
  return html`<p class="quiet">${route.direction === 'to_ros' ? 'To' : 'From'} ROS: <bdi>${route.ros}</bdi>, <bdi>${route.type}</bdi>${
    format === 'base64' ? `, in ${route.encoding}: bytes are given as base64` : ''}.
    ${typeof route.rules?.commanding === 'string' && html` Commanding now: <strong><bdi>${route.rules.commanding}</bdi></strong>.`}</p>
    ${refused.length > 0 && html`<p class="notice">Without its schema there is no form${
      format === 'cbor' ? ', and bytes go as base64' : ''}. The access rules would need the line:
      <code>topic read ${refused[0]}</code></p>`}
    ${schema && root === null && html`<p class="notice">The schema cannot be used: there is no form.</p>`}`
}

function Options() {
  return html`<details><summary>QoS, retain, expiry</summary><div class="fields">
    <div class="field"><label for="qos">QoS</label><select id="qos" name="qos"><option value="1">1, the broker answers</option>
      <option value="0">0, nobody answers</option><option value="2">2, once</option></select></div>
    <div class="field"><label for="expiry">Expires after <span class="quiet">seconds; empty: never</span></label>
      <input id="expiry" name="expiry" type="number" min="1" max="4294967295" step="1" /></div>
    <div class="field inline"><input type="checkbox" id="retain" name="retain" /><label for="retain">Retain</label></div>
  </div></details>`
}

/** What the broker answered, in words; `refused` where it names a field. Rejects without an answer. */
async function publish(topic, route, format, payload, { qos, retain, expiry }) {
  const properties = {}
  if (FORMATS[format]) properties.contentType = FORMATS[format]
  if (expiry.value) properties.messageExpiryInterval = Number(expiry.value)
  // A single command might be an old one, for a route that minds: this says that it is not.
  if (route?.rules) properties.userProperties = { 'sent-at': (Date.now() / 1000).toFixed(3) }
  const level = Number(qos.value)
  const values = { topic, payload, qos: level, retain: retain.checked, properties }
  const { code, words } = await ask('publish', values)
  if (level === 0) return { words: 'Sent. With QoS 0 nobody answers.' }
  const name = `0x${code.toString(16).padStart(2, '0')} ${ANSWERS[code] ?? ''}`.trim()
  const isBad = code >= 0x80
  const field = isBad && /(?:cannot be converted|was refused): ([^:\s]+): (.*)$/s.exec(words)
  return { words: words ? `${name}: ${words}` : `${name}.`, isBad, refused: field ? { path: field[1], words: field[2] } : null }
}

/** What is sent for the text. CBOR is made when it is needed; a schema tells it bytes from text. */
async function payloadOf(format, text, { root, value }) {
  if (format === 'base64') return bytesOf(text)
  if (format !== 'cbor') return text
  const { encode } = await import('./cbor.js')
  return encode(root, value)
}

function bytesOf(text) {
  try {
    return Uint8Array.from(atob(text), (char) => char.charCodeAt(0))
  } catch {
    throw new Error('This is not base64.')
  }
}
