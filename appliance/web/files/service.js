// A service: its request, what it answered, and how long that took.

import { useState } from './vendor/hooks.mjs'
import { signal } from './vendor/signals.mjs'
import { request } from './link.js'
import { html, Json, lack, Lacking, patience, Refused, Request, schemaOf, useRights, useShelf } from './calling.js'

const KEPT = 20 // calls of all services
const LARGEST = 128 * 1024 // characters of an answer that are kept

const history = signal([])
let number = 0

export default function Service({ entry }) {
  const { mqtt, type } = entry
  const schema = schemaOf(entry, '_Request')
  const told = useShelf([[schema, 1]])
  const rights = useRights([mqtt])
  const [isBusy, setBusy] = useState(false)
  const line = lack(rights, mqtt)
  const call = async (payload) => {
    setBusy(true)
    const begun = performance.now()
    const said = { number: ++number, mqtt, at: new Date().toLocaleTimeString(), asked: payload.slice(0, 2000) }
    try {
      const answer = await request(mqtt, payload, patience(entry))
      const more = answer.length > LARGEST ? { more: answer.length } : {}
      Object.assign(said, { answer: answer.slice(0, LARGEST), ...more })
    } catch (error) {
      said.error = error.message
    }
    said.took = Math.round(performance.now() - begun)
    history.value = [said, ...history.peek()].slice(0, KEPT)
    setBusy(false)
    return said.error ?? ''
  }
  const calls = history.value.filter((each) => each.mqtt === mqtt)
  return html`<p class="quiet"><bdi>${type}</bdi></p>
    <${Lacking} line=${line} what="call it" />
    <${Refused} told=${told} />
    <${Request} schema=${told.topics.get(schema)} word=${isBusy ? 'Waiting …' : 'Call'} lacking=${line}
      isBusy=${isBusy} send=${call} />
    <div role="status">${calls.map((each) => html`<${Call} key=${each.number} ...${each} />`)}</div>`
}

function Call({ at, took, asked, answer, error, more }) {
  return html`<article class="call">
    <p class="quiet">${at}, ${took} ms</p>
    ${error ? html`<p class="notice bad">${error}</p>` : html`<${Json} text=${answer} label="Answer" />`}
    ${more && html`<p class="quiet">Cut: the answer has ${more} characters.</p>`}
    <details><summary>Request</summary><${Json} text=${asked} label="Request" /></details></article>`
}
