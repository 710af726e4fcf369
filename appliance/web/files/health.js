// How the appliance is: what the doctor finds, the last lines of the log, the end of the audit log.

import { useState } from './vendor/hooks.mjs'
import { counted, cut, shown } from './formats.js'
import { verb } from './link.js'
import { Form, Lacking, Problem, Table, Tabs, html, lack, useAnswer, useRights } from './manage.js'

const PARTS = [['doctor', 'Doctor'], ['log', 'Log'], ['audit', 'Audit']]
const LINES = 1000
const ENTRIES = 200
const PERIOD = 5000 // ms between two looks at the log

export default function Health({ topic }) {
  const part = PARTS.some(([key]) => key === topic) ? topic : 'doctor'
  const rights = useRights(PARTS.map(([key]) => key))
  const what = { doctor: 'Examine the computer', log: 'Read the log', audit: 'Read the audit log' }[part]
  return html`<h1>Health</h1><${Tabs} page="health" parts=${PARTS} shown=${part} />
    <${Lacking} rights=${rights} of=${[[part, what]]} />
    ${part === 'doctor' ? html`<${Doctor} rights=${rights} />`
    : lack(rights, part) ? null : part === 'log' ? html`<${Log} />` : html`<${Audit} />`}`
}

const RANKS = { error: 0, warning: 1, ok: 2 }
const EXAMINATION = 120000 // ms

function Doctor({ rights }) {
  const [found, setFound] = useState(null)
  const act = async () => {
    setFound(null)
    const { findings } = await verb('doctor', {}, EXAMINATION)
    setFound(findings.filter((each) => each && typeof each === 'object')
      .sort((one, other) => RANKS[one.level] - RANKS[other.level]))
  }
  const bad = found?.filter(({ level }) => level !== 'ok').length
  return html`<p>All that the appliance needs of its computer and of ROS is examined; that takes
    seconds, on a busy computer up to two minutes, and changes nothing.</p>
    <${Form} word="Examine" busy="Examining …" lacking=${lack(rights, 'doctor')} act=${act} />
    ${found && html`<p role="status">${counted(found.length, 'finding')}, ${bad ? `${bad} to look at` : 'all is well'}.</p>
      <ul class="findings">${found.map(({ level, subject, text, advice }, index) => html`
        <li key=${index} class=${level}><strong>${level === 'ok' ? '✓' : `${level}:`} <bdi>${shown(subject)}</bdi></strong>
          <div><bdi>${shown(text, 2000)}</bdi></div>
          ${advice && html`<div class="quiet"><bdi>${shown(advice, 2000)}</bdi></div>`}</li>`)}</ul>`}`
}

function Log() {
  const [follows, follow] = useState(true)
  const [sought, seek] = useState('')
  const { answer, error, again } = useAnswer('log', { lines: LINES }, follows ? PERIOD : 0)
  const words = sought.toLowerCase()
  const lines = (answer?.lines ?? []).filter((line) => line.toLowerCase().includes(words)).reverse()
  return html`<div class="tools">
      <input type="search" aria-label="Search the log" placeholder="Search" value=${sought}
        onInput=${(event) => seek(event.currentTarget.value)} />
      <button aria-pressed=${follows} onClick=${() => follow(!follows)}>Follow</button>
      ${!follows && html`<button onClick=${again}>Refresh</button>`}
    </div>
    <${Problem} words=${error} />
    ${answer && html`<p class="quiet">${lines.length} of the last ${answer.lines.length} lines, the newest first</p>
      <ol class="log" tabindex="0" aria-label="Log">${lines.map((line, index) => html`
        <li key=${index} class=${levelOf(line)}><bdi>${shown(line, 2000)}</bdi></li>`)}</ol>`}`
}

const LEVEL = /^\S+ \S+ (WARNING|ERROR|CRITICAL)\b|"level": "(warning|error|critical)"/

/** Of a line for people, or of one in JSON. */
function levelOf(line) {
  const found = LEVEL.exec(line)
  if (found === null) return ''
  return (found[1] ?? found[2]).toLowerCase() === 'warning' ? 'warning' : 'error'
}

const NONE = 'rejected: ' // what the verb answers where there is no audit log

function NoAudit() {
  return html`<div class="notice"><p>There is no audit log: it is off unless <code>appliance.yaml</code> names a file. Add
    this to its section <code>broker</code>, and restart the appliance:</p>
    <pre>${'broker:\n  audit: {path: audit.log}'}</pre></div>`
}

function Audit() {
  const { answer, error, again } = useAnswer('audit', { lines: ENTRIES })
  const entries = (answer?.entries ?? []).filter((each) => each && typeof each === 'object').reverse()
  return html`<div class="tools"><button onClick=${again}>Refresh</button></div>
    ${error.startsWith(NONE) ? html`<${NoAudit} />` : html`<${Problem} words=${error} />`}
    ${answer && html`<p class="quiet">The last ${entries.length} entries, the newest first</p>
      <${Table} label="Audit log" heads=${[['Time', 'wide time'], ['Event', 'main'], ['Details', 'wide']]}
        rows=${entries.map(({ time, event, what, ...more }, index) => ({
    key: index,
    cells: [
      typeof time === 'string' ? cut(time.replace('T', ' ').replace('Z', ''), 30) : '–',
      html`<bdi>${shown(String(what ?? event))}</bdi>`,
      html`<bdi>${detailsOf(more)}</bdi>`,
    ],
  }))} />`}`
}

function detailsOf(more) {
  const known = Object.entries(more).filter(([, value]) => value !== null)
  const told = known.map(([name, value]) => `${name}: ${typeof value === 'string' ? value : JSON.stringify(value)}`)
  return shown(told.join(', '), 1000)
}
