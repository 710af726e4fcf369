// What the broker counts of itself, on the overview: it publishes that below $SYS, at an interval.

import { names, rows } from './link.js'
import { duration, html } from './manage.js'

const rounded = (text) => String(Math.round(Number(text)))
const SYS = '$SYS/broker/'

const FIGURES = [
  ['clients/connected', 'Clients'],
  ['subscriptions/count', 'Subscriptions'],
  ['retained messages/count', 'Retained messages'],
  ['load/messages/received/1min', 'Messages in, a minute', rounded],
  ['load/messages/sent/1min', 'Messages out, a minute', rounded],
  ['publish/messages/dropped', 'Dropped'],
  ['errors', 'Faults'],
  ['uptime', 'Up', (text) => duration(parseInt(text, 10))],
  ['version', 'Version', (text) => text.replace('appliance version ', '')],
]

export default function Figures() {
  names.value // a $SYS topic that comes for the first time
  if (!FIGURES.some(([name]) => rows.has(SYS + name))) return null
  return html`<dl class="tiles">${FIGURES.map(([name, label, inWords]) => html`
      <${Figure} key=${name} row=${rows.get(SYS + name)} label=${label} inWords=${inWords} />`)}</dl>
    <p class="quiet">The broker counts every 10 seconds, unless it is configured otherwise: who has just come is not counted yet.</p>`
}

function Figure({ row, label, inWords = String }) {
  if (!row) return null
  return html`<div><dt>${label}</dt><dd>${inWords(row.value.text)}</dd></div>`
}
