// What the pages of management share: what the user may call, what a verb answers, forms and
// questions before a change. All names come from strangers: they are shown as text, and cut.

import { h } from './vendor/preact.mjs'
import { useEffect, useLayoutEffect, useReducer, useRef, useState } from './vendor/hooks.mjs'
import htm from './vendor/htm.mjs'
import { lack, useRights as useTopicRights } from './calling.js'
import { verb } from './link.js'

export const html = htm.bind(h)

/** Of each verb why the user may not call it, '' if it may; null until that is known. */
export function useRights(verbs) {
  const topicOf = (name) => `$CONTROL/appliance/v1/${name}/_call`
  const rights = useTopicRights(verbs.map(topicOf))
  return rights && new Map(verbs.map((name) => [name, lack(rights, topicOf(name))]))
}

export { lack }

/**
 * What a verb answers: {answer, error, again}. `values` are null while it is not to be asked; `every`
 * is in ms, 0 for once. Hidden pages do not ask.
 */
export function useAnswer(name, values, every = 0) {
  const [told, setTold] = useState({ answer: null, error: '' })
  const [turn, again] = useReducer((count) => count + 1, 0)
  const asked = JSON.stringify(values)
  useEffect(() => {
    if (values === null) return undefined
    let isGone = false
    let timer = null
    const look = async () => {
      if (!document.hidden) {
        try {
          const answer = await verb(name, values)
          if (!isGone) setTold({ answer, error: '' })
        } catch (error) {
          if (!isGone) setTold(({ answer }) => ({ answer, error: error.message }))
        }
      }
      if (!isGone && every) timer = setTimeout(look, every)
    }
    look()
    return () => {
      isGone = true
      clearTimeout(timer)
    }
  }, [name, asked, every, turn])
  return { ...told, again }
}

/** The lines that the user lacks for what a page offers: pairs of a verb and what it is for. */
export function Lacking({ rights, of }) {
  const found = of.filter(([name]) => rights?.get(name))
  if (found.length === 0) return null
  return html`<div class="notice"><p>This user may not do all of this. These lines of the
    access rules, below the user’s, would allow it:</p>
    <ul>${found.map(([name, what]) => html`<li key=${name}>${what}: <code>${rights.get(name)}</code></li>`)}</ul></div>`
}

export function Problem({ words }) {
  return words ? html`<p class="notice bad" role="alert">${words}</p>` : null
}

/** Which part of a page is shown, as pairs of its place and its name. */
export function Tabs({ page, parts, shown }) {
  return html`<nav class="tabs" aria-label=${`Parts of ${page}`}>${parts.map(([key, label]) => html`
    <a key=${key} href=${`#/${page}/${key}`} aria-current=${key === shown ? 'page' : null}>${label}</a>`)}</nav>`
}

/** A table; cards where the screen is narrow. `heads` are names with a class, a row is {key, cells}. */
export function Table({ label, heads, rows }) {
  return html`<div class="scroll" tabindex="0" role="region" aria-label=${label}><table class="cards">
    <thead><tr>${heads.map(([name, kind]) => html`<th key=${name} class=${kind}>${name}</th>`)}</tr></thead>
    <tbody>${rows.map(({ key, cells }) => html`<tr key=${key}>${cells.map((cell, index) => html`
      <td key=${index} class=${heads[index][1]} data-label=${heads[index][0]}>${cell}</td>`)}</tr>`)}</tbody>
  </table></div>`
}

/**
 * A form for a change: `act` gets the fields and returns what to say, and `lacking` is the line of the
 * ACL that is missing; `busy` is what to say while it takes its time. Fields are emptied when it is done.
 */
export function Form({ word, busy, lacking, act, children }) {
  const [told, setTold] = useState({ words: '', isBad: false, isBusy: false })
  const submit = async (event) => {
    event.preventDefault()
    const form = event.currentTarget
    setTold({ words: '', isBad: false, isBusy: true })
    try {
      const words = await act(form.elements)
      form.reset()
      setTold({ words: words ?? '', isBad: false, isBusy: false })
    } catch (error) {
      setTold({ words: error.message, isBad: true, isBusy: false })
    }
  }
  return html`<form class="change" onSubmit=${submit}>
    <fieldset disabled=${Boolean(lacking) || told.isBusy}>${children}<button>${word}</button></fieldset>
    ${lacking && lacking !== '…' && html`<p class="quiet">Needs <code>${lacking}</code></p>`}
    ${busy && told.isBusy && html`<${Working} words=${busy} />`}
    ${told.words && html`<p class=${told.isBad ? 'notice bad' : 'good'} role=${told.isBad ? 'alert' : 'status'}>
      ${told.words}</p>`}</form>`
}

/** That something goes on, and for how long: the words are read aloud once, the seconds are only seen. */
function Working({ words }) {
  const [seconds, setSeconds] = useState(0)
  useEffect(() => {
    const begun = performance.now()
    const timer = setInterval(() => setSeconds(Math.floor((performance.now() - begun) / 1000)), 200)
    return () => clearInterval(timer)
  }, [])
  return html`<p class="notice"><span role="status">${words}</span> ${seconds} s</p>`
}

/** Boxes for the groups of a user; `all` are null while they are not known. */
export function Groups({ all, of }) {
  if (all === null) return null
  if (all.length === 0) return html`<p class="quiet">There are no groups: files in <code>groups</code> beside the ACL.</p>`
  return html`<fieldset class="ticks"><legend>Groups</legend>${all.map((name) => html`
    <label key=${name}><input type="checkbox" name="groups" value=${name} 
      defaultChecked=${of.includes(name)} /> ${name}</label>`)}</fieldset>`
}

/** The names of the groups that are ticked in a form. */
export function ticked(fields) {
  const boxes = fields.groups === undefined ? [] : fields.groups.length === undefined ? [fields.groups] : [...fields.groups]
  return boxes.filter(({ checked }) => checked).map(({ value }) => value)
}

/** A question before `act`, which ends with `done`; its first button changes nothing. */
export function Question({ title, word, act, done, close, children }) {
  const dialog = useRef(null)
  const [told, setTold] = useState({ words: '', isBusy: false })
  useLayoutEffect(() => { dialog.current.showModal() }, []) // a key may be pressed at once
  const go = async () => {
    setTold({ words: '', isBusy: true })
    try {
      await act()
    } catch (error) {
      setTold({ words: error.message, isBusy: false })
      return
    }
    close()
    done?.()
  }
  return html`<dialog ref=${dialog} onClose=${close} aria-labelledby="question"><h2 id="question">${title}</h2>
    ${children}<${Problem} words=${told.words} />
    <div class="tools"><button onClick=${close}>Cancel</button>
      <button class="danger" disabled=${told.isBusy} onClick=${go}>${word}</button></div></dialog>`
}

/** A time, in two units at most. */
export function duration(seconds) {
  const [days, hours, minutes] = [seconds / 86400, (seconds / 3600) % 24, (seconds / 60) % 60].map(Math.floor)
  if (days) return `${days} d${hours ? ` ${hours} h` : ''}`
  if (hours) return `${hours} h${minutes ? ` ${minutes} min` : ''}`
  const rest = Math.floor(seconds % 60)
  return minutes ? `${minutes} min${rest ? ` ${rest} s` : ''}` : `${rest} s`
}
