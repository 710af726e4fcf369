// Who is connected or has a session: a page of them at a time, and one with all of its subscriptions.

import { useState } from './vendor/hooks.mjs'
import { signal } from './vendor/signals.mjs'
import { counted, cut, shown, size } from './formats.js'
import { verb } from './link.js'
import { Lacking, Problem, Question, Table, duration, html, lack, useAnswer, useRights } from './manage.js'

const PERIOD = 5000 // ms between two looks
const LIMIT = 50 // clients of a page
const LONGEST = 2000 // characters of a name where it stands alone

const VERBS = ['clients', 'disconnect', 'delete_session']

export default function Clients({ topic: id }) {
  const rights = useRights(VERBS)
  return html`<h1>Clients</h1>
    <${Lacking} rights=${rights} of=${[
    ['clients', 'See them'], ['disconnect', 'Disconnect one'], ['delete_session', 'Delete a session']]} />
    ${lack(rights, 'clients') ? null : id ? html`<${One} key=${id} id=${id} rights=${rights} />` : html`<${List} />`}`
}

const sought = signal('')
const connected = signal('')

function List() {
  const [pages, setPages] = useState([]) // the last client of each page before this one
  const values = { limit: LIMIT }
  if (sought.value) values.search = sought.value
  if (connected.value) values.connected = connected.value === 'yes'
  if (pages.length) values.after = pages.at(-1)
  const { answer, error } = useAnswer('clients', values, PERIOD)
  const turn = (to) => {
    setPages(to)
    scrollTo(0, 0)
  }
  const from = (change) => (event) => {
    change(event.currentTarget.value)
    setPages([])
  }
  return html`
    <div class="tools">
      <input type="search" aria-label="Search clients" placeholder="Client, user or address" maxlength="200"
        value=${sought.value} onInput=${from((text) => { sought.value = text })} />
      <select aria-label="Which clients" value=${connected.value} onChange=${from((which) => { connected.value = which })}>
        <option value="">All</option><option value="yes">Connected</option><option value="no">Away</option></select>
    </div>
    <${Problem} words=${error} />
    ${answer === null ? !error && html`<p class="quiet">…</p>` : html`
      <${Table} label="Clients" heads=${HEADS} rows=${answer.clients.map(rowOf)} />
      ${answer.clients.some(({ client }) => client.startsWith('console-')) && html`<p class="quiet">A window of this console
        has up to five connections; their names are the same up to the last dash.</p>`}
      <p class="quiet" role="status">${answer.clients.length === 0 ? 'There is no such client.'
    : `${counted(answer.clients.length, 'client')}${pages.length ? `, page ${pages.length + 1}` : ''}`}</p>
      <div class="tools">
        ${pages.length > 0 && html`<button onClick=${() => turn(pages.slice(0, -1))}>Previous</button>`}
        ${answer.next !== null && html`<button onClick=${() => turn([...pages, answer.next])}>Next</button>`}
      </div>`}`
}

const HEADS = [
  ['Client', 'main'], ['User', 'wide'], ['Address', 'wide'], ['Connected', 'wide'], ['TLS', ''], ['MQTT', ''],
  ['Queue', ''], ['In flight', 'number'], ['Subscriptions', 'number'], ['Will', ''],
]

function rowOf(client) {
  return {
    key: client.client,
    cells: [
      html`<a href=${`#/clients/${encodeURIComponent(client.client)}`}><bdi>${shown(client.client)}</bdi></a>`,
      html`<bdi>${client.user === null ? '–' : shown(client.user)}</bdi>`,
      client.address ?? '–',
      since(client),
      client.connected ? client.tls ?? 'none' : '–',
      client.mqtt ?? '–',
      queueOf(client),
      client.inflight,
      client.subscription_count,
      client.will ? 'yes' : 'no',
    ],
  }
}

function since(client) {
  if (client.connected) return duration(client.connected_for ?? 0)
  return client.ends_in === undefined ? 'away' : `away, ends in ${duration(client.ends_in)}`
}

function queueOf({ queued, queued_bytes: bytes }) {
  return queued ? `${counted(queued, 'message')}, ${size(bytes)}` : 'empty'
}

function One({ id, rights }) {
  const { answer, error, again } = useAnswer('clients', { client: id }, PERIOD)
  const [asked, setAsked] = useState(null)
  const client = answer?.clients[0]
  const back = () => { location.hash = '#/clients' }
  return html`<section class="inspector" aria-labelledby="client">
    <div class="tools"><h2 id="client"><bdi>${shown(id, LONGEST)}</bdi></h2>
      <a class="button" href="#/clients">Close</a></div>
    <${Problem} words=${error} />
    ${answer !== null && !client && html`<p role="status">There is no client of this name now.</p>`}
    ${client && html`
      <dl class="properties">${factsOf(client).map(([name, value]) => html`
        <div key=${name}><dt>${name}</dt><dd><bdi>${value}</bdi></dd></div>`)}</dl>
      <div class="tools">
        <button disabled=${Boolean(lack(rights, 'disconnect')) || !client.connected}
          onClick=${() => setAsked('disconnect')}>Disconnect …</button>
        <button disabled=${Boolean(lack(rights, 'delete_session'))}
          onClick=${() => setAsked('delete_session')}>Delete its session …</button>
      </div>
      <h3>Subscriptions: ${client.subscription_count}</h3>
      <ul class="tree">${client.subscriptions.map(({ filter, qos, max_rate: rate }) => html`
        <li class="row" key=${filter}><bdi class="filter">${shown(filter, 500)}</bdi>
          <span class="rate">QoS ${qos}${rate ? `, ${rate} Hz at most` : ''}</span></li>`)}</ul>
      ${client.subscriptions.length < client.subscription_count && html`<p class="quiet">The first
        ${client.subscriptions.length}.</p>`}`}
    ${asked === 'disconnect' && html`<${Question} title="Disconnect this client?" word="Disconnect"
      act=${() => verb('disconnect', { client: id })} done=${again} close=${() => setAsked(null)}>
      <p><bdi>${shown(id)}</bdi> is told 0x98 (Administrative action). Its will is published. It may come again,
        if the access rules let it.</p></${Question}>`}
    ${asked === 'delete_session' && html`<${Question} title="Delete this session?" word="Delete"
      act=${() => verb('delete_session', { client: id })} done=${back} close=${() => setAsked(null)}>
      <p><bdi>${shown(id)}</bdi> is disconnected. Its subscriptions and ${client.queued} waiting messages are
        lost for good.</p></${Question}>`}
  </section>`
}

function factsOf(client) {
  return [
    ['user', client.user === null ? 'none' : shown(client.user, LONGEST)],
    ['connected', since(client)],
    ['address', client.address ?? '–'],
    ['TLS', client.tls ?? (client.connected ? 'none' : '–')],
    ['certificate', client.certificate ? cut(client.certificate, LONGEST) : 'none'],
    ['MQTT', client.mqtt ?? '–'],
    ['queue', queueOf(client)],
    ['in flight', counted(client.inflight, 'message')],
    ['will', client.will ? 'yes' : 'no'],
    ['session ends', client.session_expiry === 0 ? 'with the connection' : `${duration(client.session_expiry)} after it`],
  ]
}
