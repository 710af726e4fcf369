// A form for a message, from the JSON Schema of its type. It shows a value of exact.js and hands on
// another one with each change; what is folded is not drawn, so that a recursive type costs nothing.

import { h } from './vendor/preact.mjs'
import { useState } from './vendor/hooks.mjs'
import htm from './vendor/htm.mjs'
import { Num, parse, print } from './exact.js'
import { check, constantsOf, describe, initial } from './schema.js'

const html = htm.bind(h)

const ZERO = /^(0(\.0)?|""|false|\[\])$/ // what everybody expects of a field that is left out
const STEP = 50 // fields, or items, that are shown at a time

/** The fields of `value`, which is the message's. `errors` has words by path; `change` gets another value. */
export function Form({ root, value, errors, change }) {
  return html`<div class="fields"><${Inside} root=${root} part=${root} path="" value=${value} errors=${errors}
    change=${change} /></div>`
}

/** What is wrong with a value by the schema, and by the appliance's own words: by path. */
export function errorsOf(root, value, refused) {
  const found = new Map(root === null ? [] : check(root, value))
  if (refused) found.set(refused.path, refused.words)
  return found
}

/** The path of a field below another one, as the bridge writes it. */
function below(path, key) {
  if (typeof key === 'number') return `${path}[${key}]`
  return path ? `${path}.${key}` : key
}

function idOf(path) {
  return `field-${encodeURIComponent(path)}`
}

function Field({ root, part, path, name, value, errors, change, constants = [] }) {
  const wanted = describe(root, part)
  const isGroup = wanted.kind === 'object' || wanted.kind === 'array'
  if (isGroup) {
    return html`<${Group} root=${root} part=${part} wanted=${wanted} path=${path} name=${name} value=${value}
      errors=${errors} change=${change} />`
  }
  const error = errors.get(path)
  const id = idOf(path)
  return html`<div class="field">
    <label for=${id}><bdi>${name}</bdi> <span class="quiet">${hintOf(wanted)}${meaning(constants, value)}</span></label>
    <${Input} id=${id} wanted=${wanted} value=${value} change=${change} error=${error} list=${constants.length ? `${id}-list` : null} />
    ${constants.length > 0 && html`<datalist id=${`${id}-list`}>${constants.map(([label, text]) => html`
      <option key=${label} value=${text} label=${label} />`)}</datalist>`}
    <${Fault} id=${id} error=${error} /></div>`
}

/** The constant that a value is, or would be. */
function meaning(constants, value) {
  const text = plainText(value) || '0'
  const found = constants.find(([, each]) => each === text)
  return found ? `: ${found[0]}` : ''
}

function Fault({ id, error }) {
  return error ? html`<p class="bad" id=${`${id}-error`}>${error}</p>` : null
}

function hintOf({ kind, low, high, most, least, preset }) {
  const words = []
  if (kind === 'integer') words.push(low === null || high === null ? 'integer' : `${low} to ${high}`)
  else if (kind === 'octets') words.push('base64')
  else if (kind === 'any') words.push('JSON')
  else if (kind === 'number') words.push('number, or NaN')
  if (kind === 'string' && most !== null) words.push(`at most ${most} characters`)
  if (kind === 'octets' && most != null) words.push(least === most ? `${most} bytes` : `at most ${most} bytes`)
  if (preset !== undefined && !ZERO.test(print(preset))) words.push(`default ${print(preset).slice(0, 40)}`)
  return words.join(', ')
}

/** The field of one value. An absent one has its default, which the message need not name. */
function Input({ id, wanted, value, change, error, list }) {
  const common = { id, list, 'aria-invalid': error ? 'true' : null, 'aria-describedby': error ? `${id}-error` : null }
  const { kind, preset } = wanted
  if (kind === 'boolean' && (value === undefined || typeof value === 'boolean')) {
    return html`<input type="checkbox" ...${common} checked=${value ?? preset ?? false}
      onChange=${(event) => change(event.currentTarget.checked)} />`
  }
  if (kind === 'choice') {
    const texts = wanted.values.slice(0, 500).map((each) => print(each))
    return html`<select ...${common} value=${value === undefined ? '' : print(value)}
      onChange=${(event) => change(event.currentTarget.value ? parse(event.currentTarget.value) : undefined)}>
      <option value="">(left out)</option>${texts.map((each) => html`<option key=${each} value=${each}>${each}</option>`)}
    </select>`
  }
  if (kind === 'any' || value instanceof Map || Array.isArray(value)) {
    return html`<${Any} common=${common} value=${value} change=${change} />`
  }
  const isNumber = kind === 'integer' || kind === 'number'
  const type = (event) => change(isNumber ? numberOf(event.currentTarget.value, kind) : event.currentTarget.value)
  return html`<input type="text" ...${common} spellcheck=${false} autocapitalize="none" autocomplete="off"
    inputmode=${isNumber ? 'text' : null} placeholder=${isNumber ? plainText(preset ?? new Num('0')) : ''}
    value=${plainText(value)} onInput=${type} />`
}

function plainText(value) {
  if (value === undefined) return ''
  if (value === null) return 'NaN'
  return typeof value === 'string' ? value : print(value)
}

/** What somebody has typed for a number: what is none stays text, which the schema's check then names. */
function numberOf(text, kind) {
  const typed = text.trim()
  if (typed === '') return undefined
  if (kind === 'number' && /^nan$/i.test(typed)) return null
  try {
    const found = parse(typed)
    return found instanceof Num ? found : typed
  } catch {
    return typed
  }
}

function Any({ common, value, change }) {
  const [typed, setTyped] = useState(null)
  const type = (event) => {
    const text = event.currentTarget.value
    setTyped(text)
    try {
      change(text.trim() === '' ? undefined : parse(text))
    } catch {
      change(text) // a text, then
    }
  }
  return html`<input type="text" ...${common} spellcheck=${false} value=${typed ?? (value === undefined ? '' : print(value))}
    onInput=${type} onBlur=${() => setTyped(null)} />`
}

function Group({ root, part, wanted, path, name, value, errors, change }) {
  const [isOpen, setOpen] = useState(false)
  const isWrong = [...errors.keys()].some((each) => each === path || each.startsWith(`${path}.`) || each.startsWith(`${path}[`))
  const shown = isOpen || isWrong
  const now = value === 'now'
  const id = idOf(path)
  return html`<details open=${shown} onToggle=${(event) => setOpen(event.currentTarget.open)}>
    <summary><bdi>${name}</bdi> <span class="quiet">${summary(wanted, value)}</span></summary>
    ${shown && html`<div class="fields">
      ${wanted.isTime && html`<div class="field inline"><input type="checkbox" id=${id} checked=${now}
        onChange=${() => change(now ? undefined : 'now')} /><label for=${id}>now, when the robot gets it</label></div>`}
      ${!now && html`<${Inside} root=${root} part=${part} path=${path} value=${value} errors=${errors} change=${change} />`}
    </div>`}
  </details>`
}

function summary(wanted, value) {
  if (value === 'now') return 'now'
  if (wanted.kind === 'array') return counted(Array.isArray(value) ? value.length : wanted.least)
  return value instanceof Map && value.size ? '' : 'defaults'
}

function counted(count) {
  return count === 1 ? '1 item' : `${count} items`
}

/** What is in an object or an array. */
function Inside({ root, part, path, value, errors, change }) {
  const wanted = describe(root, part)
  const id = idOf(path)
  const error = errors.get(path)
  const fits = value === undefined || (wanted.kind === 'array' ? Array.isArray(value) : value instanceof Map)
  const isKnown = wanted.kind === 'array' || wanted.kind === 'object'
  const parts = { root, wanted, path, value, errors, change }
  return html`<${Fault} id=${id} error=${error} />
    ${isKnown && !fits && html`<div class="tools"><code>${print(value).slice(0, 200)}</code>
      <button type="button" onClick=${() => change(undefined)}>Remove it</button></div>`}
    ${!isKnown && html`<p class="quiet">The schema says nothing of what is in here: see the JSON.</p>`}
    ${fits && wanted.kind === 'object' && html`<${Fields} ...${parts} />`}
    ${fits && wanted.kind === 'array' && html`<${Items} ...${parts} />`}`
}

function Fields({ root, wanted, path, value = new Map(), errors, change }) {
  const [shown, setShown] = useState(STEP)
  const unknown = [...value.keys()].filter((name) => !wanted.fields.has(name)).slice(0, STEP)
  const set = (name) => (inner) => {
    const next = new Map(value)
    if (inner === undefined) next.delete(name)
    else next.set(name, inner)
    change(next)
  }
  return html`
    ${[...wanted.fields].slice(0, shown).map(([name, part]) => html`<${Field} key=${`.${name}`} root=${root} part=${part}
      path=${below(path, name)} name=${name} value=${value.get(name)} errors=${errors} change=${set(name)}
      constants=${constantsOf(wanted, name)} />`)}
    <${More} count=${wanted.fields.size} shown=${shown} show=${setShown} what="fields" />
    ${unknown.map((name) => html`<div class="field" key=${`?${name}`}><p class="bad"><bdi>${name.slice(0, 200)}</bdi>: unknown field</p>
      <button type="button" onClick=${() => set(name)(undefined)}>Remove it</button></div>`)}`
}

function Items({ root, wanted, path, value, errors, change }) {
  const [shown, setShown] = useState(STEP)
  const { item, least, most } = wanted
  const items = value ?? Array.from({ length: Math.min(least, shown) })
  const isFixed = least === most
  const whole = () => (value ? [...value] : Array.from({ length: Math.min(least, 1000) }, () => initial(root, item)))
  const set = (index) => (inner) => {
    const next = whole()
    next[index] = inner === undefined ? initial(root, item) : inner
    change(next)
  }
  const remove = (index) => () => change(items.filter((_, each) => each !== index))
  return html`
    ${items.slice(0, shown).map((inner, index) => html`<div class="item" key=${index}>
      <${Field} root=${root} part=${item} path=${below(path, index)} name=${`[${index}]`} value=${inner} errors=${errors}
        change=${set(index)} />
      ${!isFixed && html`<button type="button" aria-label=${`Remove item ${index} of ${path}`} disabled=${items.length <= least}
        onClick=${remove(index)}>Remove</button>`}</div>`)}
    <${More} count=${value ? items.length : least} shown=${shown} show=${setShown} what="items" />
    ${!isFixed && html`<div class="tools"><button type="button" disabled=${most !== null && items.length >= most}
      aria-label=${`Add an item to ${path}`} onClick=${() => change([...whole(), initial(root, item)])}>Add</button>
      ${most !== null && html`<span class="quiet">at most ${most}</span>`}</div>`}`
}

function More({ count, shown, show, what }) {
  if (count <= shown) return null
  return html`<button type="button" onClick=${() => show(shown + STEP)}>${count - shown} more ${what}</button>`
}
