// The parameters of a node: their values, and setting one, or several at once, all or none.

import { useState } from './vendor/hooks.mjs'
import { request } from './link.js'
import { html, lack, Lacking, patience, Refused, useRights, useShelf } from './calling.js'
import { parse, print } from './exact.js'
import { faultOf, valueOf } from './json-text.js'

const SHOWN = 150 // parameters
const INTEGER = /^-?\d+$/
const NUMBER = /^-?\d+(\.\d+)?([eE][+-]?\d+)?$/

/** The type of a value by its JSON: the bridge writes a double with a point. */
function typeOf(text) {
  if (text === 'true' || text === 'false') return 'bool'
  if (text[0] === '"') return 'string'
  if (INTEGER.test(text)) return 'integer'
  return NUMBER.test(text) || text === 'null' ? 'double' : 'array'
}

/** A value's JSON as it is edited, and back. */
const edited = (type, text) => (type === 'string' ? String(valueOf(text) ?? text) : text)
const written = (type, text) => (type === 'string' ? JSON.stringify(text) : text.trim())

function fault(type, text) {
  const said = text.trim()
  if (type === 'integer') return INTEGER.test(said) ? '' : 'An integer is wanted.'
  if (type === 'double') return NUMBER.test(said) ? '' : 'A number is wanted.'
  return type === 'array' ? faultOf(said) : ''
}

export default function Parameters({ entry }) {
  const { mqtt } = entry
  const told = useShelf([[`${mqtt}/+`, 10]])
  const [sought, seek] = useState('')
  const [drafts, setDrafts] = useState(new Map())
  const [state, setState] = useState({ isBusy: false, error: '', done: '' })
  const parameters = [...told.topics]
    .map(([topic, { text }]) => [topic.slice(mqtt.length + 1), text])
    .filter(([name]) => name !== '_set' && name.toLowerCase().includes(sought.toLowerCase()))
    .sort(([one], [other]) => (one < other ? -1 : 1))
  const shown = parameters.slice(0, SHOWN)
  const rights = useRights([`${mqtt}/_set`, ...shown.map(([name]) => `${mqtt}/${name}/set`)])
  const several = lack(rights, `${mqtt}/_set`)
  const line = (name) => lack(rights, `${mqtt}/${name}/set`) && several
  const lines = shown.map(([name]) => line(name)).filter(Boolean)
  const changed = [...drafts]
  const wrong = changed.find(([, { type, text }]) => fault(type, text))

  const set = async (event) => {
    event.preventDefault()
    if (changed.length === 0 || wrong) return
    setState({ isBusy: true, error: '', done: '' })
    const values = changed.map(([name, { type, text }]) => [name, written(type, text)])
    const [[name, value]] = values
    const isOne = values.length === 1 && !lack(rights, `${mqtt}/${name}/set`)
    try {
      if (isOne) await request(`${mqtt}/${name}/set`, value, patience(entry))
      else await request(`${mqtt}/_set`, print(new Map(values.map(([each, text]) => [each, parse(text)]))), patience(entry))
      // What was written meanwhile stays.
      setDrafts((now) => new Map([...now].filter(([name, { text }]) => drafts.get(name)?.text !== text)))
      setState({ isBusy: false, error: '', done: values.length === 1 ? `${name} is set.` : `${values.length} parameters are set.` })
    } catch (error) {
      setState({ isBusy: false, error: error.message, done: '' })
    }
  }
  const draft = (name, type, text, value) => {
    const next = new Map(drafts)
    if (value === edited(type, text)) next.delete(name)
    else next.set(name, { type, text: value })
    setDrafts(next)
    setState(({ isBusy }) => ({ isBusy, error: '', done: '' }))
  }
  const lacksSeveral = changed.length > 1 && several
  return html`
    <div class="tools"><input type="search" aria-label="Search parameters" placeholder="Search" value=${sought}
      onInput=${(event) => seek(event.currentTarget.value)} /></div>
    <${Refused} told=${told} />
    ${lines.length > 0 && html`<${Lacking} line=${lines[0]} what="set all of these" />`}
    <form class="publish" onSubmit=${set}>
      ${parameters.length === 0 && html`<p class="quiet">No values have come.</p>`}
      ${shown.map(([name, text]) => {
    const type = typeOf(text)
    const mine = drafts.get(name)
    return html`<${Parameter} key=${name} name=${name} type=${type} text=${mine?.text ?? edited(type, text)}
        was=${mine ? edited(type, text) : null} problem=${mine ? fault(type, mine.text) : ''} line=${line(name)}
        change=${(value) => draft(name, type, text, value)} />`
  })}
      ${parameters.length > SHOWN && html`<p class="quiet">… ${parameters.length - SHOWN} more: search for them</p>`}
      ${lacksSeveral && html`<${Lacking} line=${several} what="set several at once" />`}
      <div class="tools">
        <button disabled=${changed.length === 0 || Boolean(wrong) || Boolean(lacksSeveral) || state.isBusy}>
          ${changed.length > 1 ? `Set ${changed.length}, all or none` : 'Set'}</button>
        <button type="button" disabled=${changed.length === 0} onClick=${() => setDrafts(new Map())}>Undo</button></div>
      ${state.error && html`<p class="notice bad" role="alert">${state.error}</p>`}
      ${state.done && html`<p class="good" role="status">${state.done}</p>`}
    </form>`
}

function Parameter({ name, type, text, was, problem, line, change }) {
  const shared = {
    value: text,
    disabled: Boolean(line),
    'aria-invalid': problem ? 'true' : null,
    title: line && line !== '…' ? `Needs ${line}` : null,
    onInput: (event) => change(event.currentTarget.value),
  }
  const mode = type === 'integer' || type === 'double' ? 'decimal' : 'text'
  return html`<label class=${`parameter ${was === null ? '' : 'changed'}`}><span><bdi>${name}</bdi> <span class="quiet">${type}</span></span>
    ${type === 'bool' ? html`<select ...${shared}><option>true</option><option>false</option></select>`
    : html`<input ...${shared} inputmode=${mode} spellcheck=${false} autocomplete="off" />`}
    ${was !== null && html`<span class="quiet">was <bdi>${was}</bdi></span>`}
    ${problem && html`<span class="bad" role="alert">${problem}</span>`}</label>`
}
