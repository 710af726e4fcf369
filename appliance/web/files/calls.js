// Services, actions and parameters of nodes: the list of what is bridged, and one of them.

import { h } from './vendor/preact.mjs'
import { useMemo } from './vendor/hooks.mjs'
import { signal } from './vendor/signals.mjs'
import htm from './vendor/htm.mjs'
import { allRoutes, robot as own, robots } from './link.js'
import Goals from './goals.js'
import Parameters from './parameters.js'
import Service from './service.js'

const html = htm.bind(h)

const SHOWN = 200 // rows of each kind
const KINDS = [['service', 'Services', Service], ['action', 'Actions', Goals], ['parameters', 'Parameters', Parameters]]

const sought = signal('')

/** What can be called, of all robots, this one's first. */
function callable() {
  const kinds = KINDS.map(([kind]) => kind)
  return allRoutes().filter(({ direction }) => kinds.includes(direction))
    .sort((one, other) => (other.robot === own) - (one.robot === own) || (one.ros < other.ros ? -1 : 1))
}

export default function Calls({ topic }) {
  const entries = useMemo(callable, [robots.value])
  const opened = entries.find(({ mqtt }) => mqtt === topic)
  const [, , Opened] = KINDS.find(([kind]) => kind === opened?.direction) ?? []
  return html`<div class=${`topics ${topic ? 'inspecting' : ''}`}>
    <div class="list"><h1>Calls</h1><${List} entries=${entries} topic=${topic} /></div>
    ${topic && html`<section class="inspector" aria-labelledby="opened">
      <div class="tools"><h2 id="opened"><bdi>${opened?.ros ?? topic}</bdi></h2>
        <a class="button" href="#/calls">Close</a></div>
      ${opened && html`<p class="quiet">Called at <bdi>${opened.mqtt}</bdi>${opened.robot === own ? '' : html`, of <bdi>${opened.robot}</bdi>`}</p>`}
      ${opened ? html`<${Opened} key=${topic} entry=${opened} />`
    : html`<p class="notice">It is not on the bus now, or not bridged.</p>`}</section>`}
  </div>`
}

function List({ entries, topic }) {
  const words = sought.value.toLowerCase().split(/\s+/).filter(Boolean)
  const found = entries.filter(({ ros, type }) => words.every((word) => `${ros} ${type}`.toLowerCase().includes(word)))
  return html`
    <div class="tools"><input type="search" aria-label="Search calls" placeholder="Search" value=${sought.value}
      onInput=${(event) => { sought.value = event.currentTarget.value }} /></div>
    ${entries.length === 0 && html`<p class="notice">No services, actions or parameters are bridged
      (<code>bridge.services</code>, <code>actions</code>, <code>parameters</code> in appliance.yaml), or this user may
      not read {robot}/_appliance/routes.</p>`}
    ${KINDS.map(([kind, label]) => html`<${Kind} key=${kind} label=${label} topic=${topic}
      entries=${found.filter(({ direction }) => direction === kind)} />`)}`
}

function Kind({ label, entries, topic }) {
  if (entries.length === 0) return null
  return html`<h2>${label} <span class="quiet">${entries.length}</span></h2>
    <ul class="tree">${entries.slice(0, SHOWN).map(({ ros, mqtt, type, direction, robot }) => html`<li key=${mqtt}>
      <a class="row" href=${`#/calls/${encodeURIComponent(mqtt)}`} aria-current=${mqtt === topic ? 'true' : null}>
        <span class="name"><bdi>${ros}</bdi>${robot === own ? '' : html` <span class="quiet">of <bdi>${robot}</bdi></span>`}</span><span class="value"><bdi>${direction === 'parameters' ? '' : type}</bdi></span></a></li>`)}
    ${entries.length > SHOWN && html`<li class="quiet">… ${entries.length - SHOWN} more: search for them</li>`}</ul>`
}
