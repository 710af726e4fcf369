// What the pages of calls share: topics that are kept while one is open, rights, and the request's form.

import { h } from './vendor/preact.mjs'
import { useEffect, useMemo, useState } from './vendor/hooks.mjs'
import htm from './vendor/htm.mjs'
import { shelf, shelve, verb } from './link.js'
import { Editor, mayBeSent, useMessage, withoutEnter } from './editor.js'
import { indented } from './json-text.js'

export const html = htm.bind(h)

const MOST_QUESTIONS = 200 // of the verb `rights` in one call
const LONGEST = 600 // seconds that an answer is waited for
const LARGEST = 1024 * 1024 // characters of a request
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
  const shown = useMemo(() => indented(text), [text])
  return html`<pre tabindex="0" aria-label=${label}>${shown}</pre>`
}

/** What is wrong with a field, by the words of a call that was refused; null where they name none. */
function refusedField(words) {
  const found = /^bad_request: ([\w.[\]]+): (.*)$/s.exec(words)
  return found && { path: found[1], words: found[2] }
}

/** A form for a request; fields that are left out have their default. `send` gets its text, and returns what went wrong. */
export function Request({ schema, word, lacking, isBusy, send }) {
  const [text, setText] = useState('{}')
  const [refused, setRefused] = useState(null)
  const message = useMessage(text, schema, refused)
  const edit = (next) => {
    setText(next)
    setRefused(null)
  }
  const submit = async (event) => {
    event.preventDefault()
    if (!mayBeSent(message, refused, event.currentTarget)) return
    setRefused(refusedField(await send(text)))
  }
  return html`<form class="publish request" onSubmit=${submit} onKeyDown=${withoutEnter}>
    <${Editor} label="Request" text=${text} message=${message} most=${LARGEST} edit=${edit} />
    <div class="tools"><button disabled=${Boolean(lacking) || isBusy}>${word}</button>
      <button type="button" disabled=${text === '{}'} onClick=${() => edit('{}')}>Start again</button></div>
  </form>`
}
