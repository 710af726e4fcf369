// An action: sending a goal, and all goals that the robot knows, whoever sent them.

import { useState } from './vendor/hooks.mjs'
import { request } from './link.js'
import { html, Json, lack, Lacking, patience, Refused, Request, schemaOf, useRights, useShelf } from './calling.js'
import { valueOf } from './json-text.js'

const SHOWN = 30 // goals, the newest first
const FEEDBACK_RATE = 10 // a second
const OWN = 100 // goals of this page that are remembered
const RUNNING = new Set(['accepted', 'executing'])

const sent = new Map() // goal id → {mqtt, at}, until the page is loaded again

export default function Goals({ entry }) {
  const { mqtt, type } = entry
  const schema = schemaOf(entry, '_Goal')
  const told = useShelf([[schema, 1], [`${mqtt}/_status`, 10], [`${mqtt}/_result/+`, 10], [`${mqtt}/_feedback/+`, FEEDBACK_RATE]])
  const rights = useRights(['_goal', '_cancel', '_cancel_any'].map((part) => `${mqtt}/${part}`))
  const [state, setState] = useState({ isBusy: false, error: '' })
  const line = lack(rights, `${mqtt}/_goal`)
  const send = async (payload) => {
    setState({ isBusy: true, error: '' })
    try {
      remember(mqtt, valueOf(await request(`${mqtt}/_goal`, payload, patience(entry)))?.goal_id)
      setState({ isBusy: false, error: '' })
      return ''
    } catch (error) {
      setState({ isBusy: false, error: error.message })
      return error.message
    }
  }
  const goals = goalsOf(mqtt, told.topics)
  return html`<p class="quiet"><bdi>${type}</bdi></p>
    <${Lacking} line=${line} what="send goals" />
    <${Lacking} line=${lack(rights, `${mqtt}/_cancel`)} what="cancel goals" />
    <${Refused} told=${told} />
    <${Request} schema=${told.topics.get(schema)} word=${state.isBusy ? 'Waiting …' : 'Send goal'} lacking=${line}
      isBusy=${state.isBusy} send=${send} />
    ${state.error && html`<p class="notice bad" role="alert">${state.error}</p>`}
    <h3>Goals <span class="quiet">${goals.length}</span></h3>
    ${goals.length === 0 && html`<p class="quiet">None is known.</p>`}
    ${goals.slice(0, SHOWN).map((goal) => html`<${Goal} key=${goal.id} goal=${goal} entry=${entry} rights=${rights} />`)}
    ${goals.length > SHOWN && html`<p class="quiet">… ${goals.length - SHOWN} older ones</p>`}`
}

function remember(mqtt, id) {
  if (typeof id !== 'string') return
  sent.set(id, { mqtt, at: Math.round(Date.now() / 1000) })
  if (sent.size > OWN) sent.delete(sent.keys().next().value)
}

/** All goals of an action: those of `_status`, of this page, and those with feedback or a result. */
function goalsOf(mqtt, topics) {
  const goals = new Map()
  const goal = (id) => {
    if (!goals.has(id)) goals.set(id, { id, status: '', at: 0, isOwn: false, feedback: null, result: null })
    return goals.get(id)
  }
  for (const [id, own] of sent) {
    if (own.mqtt === mqtt) Object.assign(goal(id), { isOwn: true, at: own.at })
  }
  const known = valueOf(topics.get(`${mqtt}/_status`)?.text ?? '[]')
  for (const each of Array.isArray(known) ? known : []) {
    if (typeof each?.goal_id !== 'string') continue
    Object.assign(goal(each.goal_id), { status: String(each.status), at: Number(each.stamp?.sec) || 0 })
  }
  for (const [topic, kept] of topics) {
    const [part, id] = topic.slice(mqtt.length + 1).split('/')
    if (part === '_feedback') goal(id).feedback = kept
    if (part === '_result') Object.assign(goal(id), { result: kept, ...outcome(kept) })
  }
  return [...goals.values()].sort((one, other) => other.at - one.at)
}

function outcome({ isJson, text }) {
  const status = isJson ? valueOf(text)?.status : undefined
  return typeof status === 'string' ? { status } : {}
}

function Goal({ goal, entry, rights }) {
  const { id, status, at, isOwn, feedback, result } = goal
  const [state, setState] = useState({ isBusy: false, error: '' })
  const mayAny = entry.cancel === 'any' || lack(rights, `${entry.mqtt}/_cancel_any`) === ''
  const cancel = async () => {
    setState({ isBusy: true, error: '' })
    try {
      await request(`${entry.mqtt}/_cancel`, JSON.stringify({ goal_id: id }), patience(entry))
      setState({ isBusy: false, error: '' })
    } catch (error) {
      setState({ isBusy: false, error: error.message })
    }
  }
  const isRunning = result === null && (RUNNING.has(status) || (isOwn && !status))
  return html`<article class="call" aria-label=${`Goal ${id}`}>
    <div class="tools"><p><code>${id.slice(0, 8)}</code> <strong class=${status === 'aborted' ? 'bad' : ''}>${status || 'sent'}</strong>
      <span class="quiet">${at ? ` ${new Date(at * 1000).toLocaleTimeString()}` : ''}${isOwn ? ', sent here' : ''}</span></p>
      ${isRunning && html`<button disabled=${Boolean(lack(rights, `${entry.mqtt}/_cancel`)) || state.isBusy}
        onClick=${cancel}>Cancel</button>`}</div>
    ${isRunning && !isOwn && !mayAny && html`<p class="quiet">Not sent from here. It is cancelled if the same user sent it;
      for goals of others the access rules would need the line: <code>topic write ${entry.mqtt}/_cancel_any</code></p>`}
    ${state.error && html`<p class="notice bad" role="alert">${state.error}</p>`}
    ${feedback && html`<p class="quiet">Feedback${feedback.rate ? `, ${feedback.rate >= FEEDBACK_RATE - 1 ? '≥ ' : ''}${feedback.rate} Hz` : ''}</p>
      <${Json} text=${feedback.text} label="Feedback" />`}
    ${result && html`<p class="quiet">Result</p><${Json} text=${result.text} label="Result" />`}
  </article>`
}
