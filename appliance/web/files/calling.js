// What the pages of calls share: topics that are kept while one is open, rights, and the request's form.

import { h } from './vendor/preact.mjs'
import { useEffect, useState } from './vendor/hooks.mjs'
import htm from './vendor/htm.mjs'
import { shelf, shelve, verb } from './link.js'
import { blank, faultOf, indented, valueOf } from './json-text.js'

export const html = htm.bind(h)

const MOST_QUESTIONS = 200 // of the verb `rights` in one call
const LONGEST = 600 // seconds that an answer is waited for
const RESERVE = 2 // seconds until the appliance's own answer, that time is over, has come

/** Keep topics while a page is open and can be seen: pairs of a filter and messages a second. */
export function useShelf(wanted) {
  useEffect(() => {
    const change = () => shelve(document.hidden ? [] : wanted)
    change()
    document.addEventListener('visibilitychange', change)
    return () => {
      document.removeEventListener('visibilitychange', change)
      shelve([])
    }
  }, [JSON.stringify(wanted)])
  return shelf.value
}

/** Of each topic why the user may not publish there, '' if it may; null until that is known. */
export function useRights(topics) {
  const [rights, setRights] = useState(null)
  useEffect(() => {
    let isGone = false
    const questions = topics.slice(0, MOST_QUESTIONS).map((topic) => ({ action: 'publish', topic }))
    verb('rights', { questions }).then(
      (answer) => new Map(answer.rights.map(({ topic, allowed, line, reason }) => [topic, allowed ? '' : line ?? reason])),
      () => new Map(), // then each call says itself that it is not allowed
    ).then((found) => isGone || setRights(found))
    return () => { isGone = true }
  }, [topics.join('\n')])
  return rights
}

/** What keeps the user from publishing there: a line of the ACL, or '' if nothing does. */
export function lack(rights, topic) {
  return rights === null ? '…' : rights.get(topic) ?? ''
}

/** The line of the ACL that is missing for something. */
export function Lacking({ line, what }) {
  if (!line || line === '…') return null
  return html`<p class="notice">This user may not ${what}. The access rules would
    need the line: <code>${line}</code></p>`
}

export function Refused({ told }) {
  return told.refused.map((filter) => html`<p key=${filter} class="notice">This user may not read
    <code>${filter}</code>. The access rules would need the line: <code>topic read ${filter}</code></p>`)
}

/** Milliseconds that an answer to a route's call may take. */
export function patience({ timeout }) {
  const seconds = Number.isFinite(timeout) ? timeout : 5
  return (Math.min(seconds, LONGEST) + RESERVE) * 1000
}

/** The topic of the schema of a part of a route's type. */
export function schemaOf({ robot, type }, part) {
  return `${robot}/_appliance/schema/${type.replace('/msg/', '/')}${part}`
}

export function Json({ text, label }) {
  return html`<pre tabindex="0" aria-label=${label}>${indented(text)}</pre>`
}

/** A form for a request: JSON, filled in with the defaults of its schema. `send` gets its text. */
export function Request({ schema, word, lacking, isBusy, send }) {
  const [text, setText] = useState(null)
  const [fault, setFault] = useState('')
  const described = schema?.isJson ? valueOf(schema.text) : undefined
  const filled = text ?? (described ? blank(described) : '{}')
  const submit = (event) => {
    event.preventDefault()
    const found = filled.trim() ? faultOf(filled) : ''
    setFault(found)
    if (!found) send(filled)
  }
  return html`<form class="request" onSubmit=${submit}>
    <label>Request <textarea rows=${Math.min(16, filled.split('\n').length + 1)} spellcheck=${false}
      aria-invalid=${fault ? 'true' : null} value=${filled}
      onInput=${(event) => setText(event.currentTarget.value)}></textarea></label>
    ${fault && html`<p class="bad" role="alert">${fault}</p>`}
    <div class="tools"><button disabled=${Boolean(lacking) || isBusy}>${word}</button>
      <button type="button" disabled=${text === null} onClick=${() => { setText(null); setFault('') }}>Defaults</button></div>
    ${schema && html`<details><summary>Schema</summary><${Json} text=${schema.text} label="Schema" /></details>`}
  </form>`
}
