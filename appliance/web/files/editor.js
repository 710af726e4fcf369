// A message as a form, by the schema of its type, and as JSON beside it: both are in step. What is sent
// is the text as it stands, so that no number goes through a float.

import { h } from './vendor/preact.mjs'
import { useMemo } from './vendor/hooks.mjs'
import htm from './vendor/htm.mjs'
import { parse, print } from './exact.js'
import { errorsOf, Form } from './form.js'
import { schemaOf } from './schema.js'

const html = htm.bind(h)

const ROWS = 24
const NOTHING = new Map()

/**
 * What is known of a message's text: `root` is its schema, null where there is none, `fault` says why
 * it is no JSON, and `errors` are words by the path of a field. `schema` is the kept topic of the
 * schema, `refused` has the path and words of what was answered last.
 */
export function useMessage(text, schema, refused, isJson = true) {
  const root = useMemo(() => (schema?.isJson ? schemaOf(schema.text) : null), [schema?.text])
  const read = useMemo(() => (isJson ? reading(text) : {}), [text, isJson])
  const errors = useMemo(
    () => (read.value === undefined ? NOTHING : errorsOf(root, read.value, refused)),
    [root, read, refused],
  )
  return { root, ...read, errors }
}

function reading(text) {
  try {
    return { value: parse(text) }
  } catch (error) {
    return { fault: error.message }
  }
}

/** Whether a message is right, or wrong by the robot's last word alone; else its first mistake has the focus. */
export function mayBeSent({ fault, errors }, refused, form) {
  if (!fault && (errors.size === 0 || (refused && errors.size === 1))) return true
  setTimeout(() => form.querySelector('[aria-invalid]')?.focus())
  return false
}

/** Of a form for a message: a robot may move by what is sent, and Enter in a field is no decision to do so. */
export function withoutEnter(event) {
  if (event.key === 'Enter' && event.target.tagName === 'INPUT') event.preventDefault()
}

/** The form and the text; `edit` gets another text with each change. */
export function Editor({ label, text, message, most, edit }) {
  const { root, value, fault, errors } = message
  const rows = Math.min(ROWS, text.split('\n', ROWS).length + 2)
  return html`<div class=${root ? 'both' : ''}>
    ${root && (value === undefined
    ? html`<p class="notice">The form is there again when the JSON is right.</p>`
    : html`<${Form} root=${root} value=${value} errors=${errors} change=${(next) => edit(print(next))} />`)}
    <div class="raw"><label>${label}
      <textarea rows=${rows} spellcheck=${false} maxlength=${most} value=${text}
        aria-invalid=${fault ? 'true' : null} onInput=${(event) => edit(event.currentTarget.value)}></textarea></label>
      ${fault && html`<p class="bad" role="alert">Not JSON: ${fault}</p>`}
      <${Errors} errors=${errors} /></div>
  </div>`
}

function Errors({ errors }) {
  if (errors.size === 0) return null
  return html`<ul class="warnings" aria-label="What is wrong">${[...errors].slice(0, 20).map(([path, words]) => html`
    <li key=${path}><strong><bdi>${path.slice(0, 200) || 'The message'}</bdi></strong> ${words}</li>`)}</ul>`
}
