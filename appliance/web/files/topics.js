// The tree of topics with values and rates, and the inspector of one of them.

import { h } from './vendor/preact.mjs'
import { useEffect, useMemo, useRef, useState } from './vendor/hooks.mjs'
import { computed, signal } from './vendor/signals.mjs'
import htm from './vendor/htm.mjs'
import { counted, shown } from './formats.js'
import { ask, focus, inspected, isPaused, names, pause, robot, robots, rows, tell, untold } from './link.js'
import { save } from './save.js'

const html = htm.bind(h)

const SHOWN = 200 // rows of a level, and of what was found
const OPEN = 60 // a tree of so many topics is shown unfolded

export default function Topics({ topic }) {
  useEffect(() => {
    focus(topic)
    return () => focus('')
  }, [topic])
  useEffect(() => () => { if (isPaused.peek()) pause(false) }, []) // other pages have no button for it
  const before = useRef(topic)
  useEffect(() => {
    const closed = before.current
    before.current = topic
    // On a narrow screen the tree and the inspector take each other's place: so does the focus.
    if (topic === closed || hasFocus()) return
    const links = [...document.querySelectorAll('.list a.row')]
    const next = topic ? document.getElementById('inspected') : links.find((link) => link.getAttribute('href') === hrefOf(closed))
    ;(next ?? document.querySelector('main'))?.focus()
  }, [topic])
  return html`<div class=${`topics ${topic ? 'inspecting' : ''}`}>
    <div class="list"><h1>Topics</h1><${Tree} topic=${topic} /></div>
    ${topic && html`<${Inspector} key=${topic} topic=${topic} />`}
  </div>`
}

const hrefOf = (topic) => `#/topics/${encodeURIComponent(topic)}`

/** Whether something that is shown has the focus. The page as a whole has it in Safari, where a click gives a link none. */
function hasFocus() {
  const at = document.activeElement
  return at !== null && at !== document.body && at.localName !== 'main' && at.getClientRects().length > 0
}

const sought = signal('')
const unfolded = signal(new Map())

function Tree({ topic }) {
  const all = names.value
  const words = sought.value.toLowerCase().split(/\s+/).filter(Boolean)
  const found = useMemo(
    () => (words.length ? all.filter((name) => words.every((word) => name.toLowerCase().includes(word))) : all),
    [all, words.join(' ')],
  )
  const root = useMemo(() => (words.length ? null : branch(all)), [all, words.length === 0])
  return html`
    <div class="tools">
      <input type="search" aria-label="Search topics" placeholder="Search" value=${sought.value}
        onInput=${(event) => { sought.value = event.currentTarget.value }} />
      <button aria-pressed=${isPaused.value} onClick=${() => pause(!isPaused.value)}>
        ${isPaused.value ? 'Continue' : 'Pause'}</button>
    </div>
    <p class="quiet" role="status">${counted(found.length, 'topic')}${untold.value > 0
  ? `; more than can be kept, ${untold.value} messages of others were left out` : ''}</p>
    <ul class="tree">${root === null
    ? found.slice(0, SHOWN).map((name) => html`<${Row} key=${name} name=${name} label=${name} topic=${topic} />`)
    : html`<${Level} level=${root} path="" topic=${topic} isOpen=${all.length <= OPEN} />`}
    ${root === null && found.length > SHOWN && html`<li class="quiet">… ${found.length - SHOWN} more</li>`}</ul>`
}

/** The topics as a tree: {name, topic or null, inner: Map}. */
function branch(all) {
  const root = { inner: new Map(), count: 0 }
  for (const topic of all) {
    let level = root
    const parts = topic.split('/')
    const some = parts.length > 12 ? [...parts.slice(0, 11), parts.slice(11).join('/')] : parts
    for (const part of some) {
      let inner = level.inner.get(part)
      if (inner === undefined) {
        inner = { inner: new Map(), topic: null, count: 0 }
        level.inner.set(part, inner)
      }
      level.count += 1
      level = inner
    }
    level.topic = topic
  }
  return root
}

function Level({ level, path, topic, isOpen }) {
  const entries = [...level.inner]
  return html`${entries.slice(0, SHOWN).map(([part, inner]) => html`
    <${Branch} key=${part} part=${part} inner=${inner} path=${`${path}/${part}`} topic=${topic} isOpen=${isOpen} />`)}
    ${entries.length > SHOWN && html`<li class="quiet">… ${entries.length - SHOWN} more: search for them</li>`}`
}

function Branch({ part, inner, path, topic, isOpen }) {
  if (inner.inner.size === 0) return html`<${Row} name=${inner.topic} label=${part} topic=${topic} />`
  const is = unfolded.value.get(path) ?? (isOpen && !path.startsWith('/$'))
  const toggle = () => { unfolded.value = new Map(unfolded.value).set(path, !is) }
  return html`<li>
    <div class="row"><button class="fold" aria-expanded=${is} onClick=${toggle}>
      <span aria-hidden="true">${is ? '▾' : '▸'}</span> <bdi>${shown(part)}</bdi></button>
      <span class="quiet">${inner.count}</span></div>
    ${inner.topic !== null && html`<ul><${Row} name=${inner.topic} label="(itself)" topic=${topic} /></ul>`}
    ${is && html`<ul><${Level} level=${inner} path=${path} topic=${topic} isOpen=${isOpen} /></ul>`}
  </li>`
}

function Row({ name, label, topic }) {
  const row = rows.get(name)?.value
  if (row === undefined) return null
  return html`<li><a class="row" href=${hrefOf(name)}
      aria-current=${name === topic ? 'true' : null} title=${shown(name)}>
    <bdi class="name">${shown(label)}</bdi>
    <span class="value">${row.text}</span>
    <span class="rate">${rateOf(name, row)}</span></a></li>`
}

/** The rates of what is bridged, by topic; what this robot says counts before what others do. */
const rates = computed(() => {
  const found = new Map()
  for (const about of [...robots.value.values(), robots.value.get(robot)]) {
    for (const { mqtt, direction, rate } of about?.routes ?? []) {
      if (direction === 'to_mqtt' && Number.isFinite(rate)) found.set(mqtt, rate)
    }
  }
  return found
})

/** Messages a second: of a bridged topic as the bridge counts them, of others as many as come here. */
function rateOf(name, row) {
  const bridged = rates.value.get(name)
  if (bridged !== undefined) return `${bridged} Hz`
  if (row.rate < 0.05) return row.retain ? 'retained' : ''
  return row.rate >= 1.8 ? '≥ 2 Hz' : `${row.rate.toFixed(1)} Hz`
}

// --- the inspector ---------------------------------------------------------------------------

function Inspector({ topic }) {
  const told = inspected.value
  const message = told?.topic === topic ? told.message : null
  const keep = async () => save(await ask('export'), `${topic}.jsonl`)
  return html`<section class="inspector" aria-labelledby="inspected">
    <div class="tools"><h2 id="inspected" tabindex="-1"><bdi>${shown(topic)}</bdi></h2>
      <a class="button" href=${`#/publish/${encodeURIComponent(topic)}`}>Publish</a>
      <a class="button" href="#/topics">Close</a></div>
    ${told?.reason && html`<p class="notice bad" role="alert">${told.reason}</p>`}
    ${message === null ? html`<p class="quiet">Nothing has come yet.</p>` : html`
      <div class="tools">
        <button aria-pressed=${isPaused.value} onClick=${() => pause(!isPaused.value)}>
          ${isPaused.value ? 'Continue' : 'Pause'}</button>
        <button onClick=${keep}>Export ${counted(told.kept, 'message')}</button>
        ${message.kind === 'image' && html`<a class="button" href=${`#/camera/${encodeURIComponent(topic)}`}>Camera</a>`}
      </div>
      <dl class="properties">
        <div><dt>received</dt><dd>${clock(message.at)}</dd></div>
        <div><dt>size</dt><dd>${message.size} B</dd></div>
        <div><dt>QoS</dt><dd>${message.qos}${message.retain ? ', retained' : ''}</dd></div>
        ${message.properties.map(([name, value]) => html`<div><dt><bdi>${name}</bdi></dt><dd><bdi>${value}</bdi></dd></div>`)}
      </dl>
      ${told.path !== null && html`<${Plot} points=${told.points} path=${told.path} />`}
      ${message.note && html`<p class="quiet">${message.note}</p>`}
      ${message.leaves && html`<${Leaves} leaves=${message.leaves} path=${told.path} />`}
      ${message.text !== null && html`<pre tabindex="0">${message.text}</pre>`}
      ${told.bitmap && html`<${Picture} bitmap=${told.bitmap} />`}
      <${History} told=${told} message=${message} />`}
  </section>`
}

function Leaves({ leaves, path }) {
  return html`<div class="scroll"><table class="leaves">
    <thead><tr><th>Field</th><th>Value</th><th>Before</th><th>Plot</th></tr></thead>
    <tbody>${leaves.map(([name, text, isNumber, was]) => html`
      <tr key=${name} class=${was === null ? '' : 'changed'}>
        <td><bdi>${name || '(the value)'}</bdi></td>
        <td class="text"><bdi>${text}</bdi></td>
        <td class="text quiet"><bdi>${was ?? ''}</bdi></td>
        <td>${isNumber && html`<button class="quiet" aria-pressed=${name === path} aria-label=${`Plot ${name}`}
          onClick=${() => tell('plot', { path: name === path ? null : name })}>∿</button>`}</td>
      </tr>`)}</tbody></table></div>`
}

function History({ told, message }) {
  return html`<details><summary>History: ${counted(told.kept, 'message')}</summary>
    <ul class="tree">${[...told.history].reverse().map(([number, at, size, text]) => html`
      <li key=${number}><button class="row" aria-current=${number === message.number ? 'true' : null}
        onClick=${() => tell('show', { index: number })}>
        <span class="name">${clock(at)}</span><span class="value">${text}</span>
        <span class="rate">${size} B</span></button></li>`)}</ul>
    <button onClick=${() => tell('show', { index: null })}>Follow the newest</button></details>`
}

function clock(at) {
  const parts = { hour: 'numeric', minute: '2-digit', second: '2-digit', fractionalSecondDigits: 3 }
  return new Date(at).toLocaleTimeString(undefined, parts)
}

function Picture({ bitmap }) {
  const canvas = useRef(null)
  useEffect(() => {
    const element = canvas.current
    if (!bitmap.width) return
    element.width = bitmap.width
    element.height = bitmap.height
    element.getContext('2d').drawImage(bitmap, 0, 0)
  }, [bitmap])
  return html`<canvas class="picture" ref=${canvas} role="img" aria-label="The picture" />`
}

function Plot({ points, path }) {
  const place = useRef(null)
  const plot = useRef(null)
  useEffect(() => {
    let isGone = false
    import('./plot.js').then(({ makePlot }) => {
      if (!isGone) plot.current = makePlot(place.current, path, points)
    })
    return () => {
      isGone = true
      plot.current?.destroy()
      plot.current = null
    }
  }, [path])
  useEffect(() => { plot.current?.show(points) }, [points])
  const last = points.at(-1)
  return html`<figure><figcaption>${path}: ${last ? last[1] : 'no number yet'} (${points.length} points)</figcaption>
    <div class="plot" ref=${place} /></figure>`
}
