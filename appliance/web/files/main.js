// The page: sign in, what is above and below each page, the overview; other pages come when asked for.

import { h, render } from './vendor/preact.mjs'
import { useEffect, useState } from './vendor/hooks.mjs'
import { signal } from './vendor/signals.mjs'
import htm from './vendor/htm.mjs'
import { resume, robot, robots, session, signIn, signOut, user } from './link.js'
import { isTopic } from './topic-name.js'

const html = htm.bind(h)

const PAGES = [
  ['overview', 'Overview'],
  ['topics', 'Topics'],
  ['publish', 'Publish'],
  ['routes', 'Routes'],
  ['drive', 'Drive'],
  ['calls', 'Calls'],
  ['camera', 'Camera'],
  ['map', 'Map'],
  ['clients', 'Clients'],
  ['access', 'Access'],
  ['health', 'Health'],
]
const LOADERS = {
  bridged: () => import('./bridged.js'), // of the overview
  figures: () => import('./figures.js'), // also
  topics: () => import('./topics.js'),
  publish: () => import('./publish.js'),
  routes: () => import('./routes.js'),
  drive: () => import('./drive.js'),
  calls: () => import('./calls.js'),
  camera: () => import('./camera.js'),
  map: () => import('./map.js'),
  clients: () => import('./clients.js'),
  access: () => import('./access.js'),
  health: () => import('./health.js'),
  enrol: () => import('./enrol.js'),
}

const OF_A_TOPIC = ['topics', 'publish', 'camera']

const place = signal(where())

function where() {
  const [, page = '', ...rest] = location.hash.split('/')
  const isKnown = page === 'enrol' || PAGES.some(([name]) => name === page)
  let topic = ''
  try {
    topic = decodeURIComponent(rest.join('/'))
  } catch {
    // Not from this page, then.
  }
  return { page: isKnown ? page : 'overview', topic }
}

addEventListener('hashchange', () => { place.value = where() })

function Console() {
  const { page, topic } = place.value
  if (page === 'enrol') return html`<${Later} key=${page} page=${page} topic=${topic} />`
  const { name } = session.value
  if (name === 'leaving') return html`<p role="status">Signing out …</p>`
  return name === 'in' || name === 'lost' ? html`<${Frame} />` : html`<${SignIn} />`
}

function Frame() {
  const { name, reason } = session.value
  const { page, topic } = place.value
  useEffect(() => {
    document.querySelector('main')?.focus()
    document.querySelector('header nav [aria-current]')?.scrollIntoView({ block: 'nearest', inline: 'nearest' })
  }, [page])
  return html`
    <header>
      <strong class="robot">${robot}</strong>
      <nav aria-label="Pages">${PAGES.map(([key, label]) => html`
        <a href=${`#/${key}`} aria-current=${key === page ? 'page' : null}>${label}</a>`)}</nav>
      <span class="user">${user.value}
        <button class="quiet" onClick=${signOut}>Sign out</button></span>
    </header>
    ${(name === 'lost' || reason) && html`<p class="notice bad" role="alert">${reason}</p>`}
    <main tabindex="-1"><${Page} page=${page} topic=${topic} /></main>`
}

function Page({ page, topic }) {
  if (page === 'overview') return html`<${Overview} />`
  if (topic && OF_A_TOPIC.includes(page) && !isTopic(topic)) {
    return html`<p class="notice bad" role="alert">This is not the name of a topic: it has a wildcard (+ or #), or is too
      long. <a href=${`#/${page}`}>Choose one</a></p>`
  }
  return html`<${Later} key=${page} page=${page} topic=${topic} />`
}

function Later({ page, topic }) {
  const [Page, setPage] = useState(null)
  useEffect(() => {
    LOADERS[page]().then(
      (module) => setPage(() => module.default),
      () => setPage(() => () => html`<p class="notice bad" role="alert">This page could not be loaded.
        Reload it: the robot may have a newer one.</p>`),
    )
  }, [page])
  return Page === null ? html`<p class="quiet">…</p>` : html`<${Page} topic=${topic} />`
}

// --- sign in ---------------------------------------------------------------------------------

const LOOPBACK = /^(localhost|127(\.\d+){3}|\[::1\])$/

function SignIn() {
  const { name, reason } = session.value
  const [fingerprint, setFingerprint] = useState('')
  const [parts, setParts] = useState(null)
  const isSafe = location.protocol === 'https:' || LOOPBACK.test(location.hostname)
  useEffect(() => {
    caFingerprint().then(setFingerprint, () => {})
    readiness().then(setParts, () => {})
  }, [])
  const submit = (event) => {
    event.preventDefault()
    const form = event.currentTarget
    const password = form.elements.password.value
    form.elements.password.value = ''
    signIn(form.elements.user.value, password).catch(() => {})
  }
  const isBusy = name === 'connecting'
  return html`<main class="sign-in">
    <h1>${robot}</h1>
    <form onSubmit=${submit}>
      <label>User name <input name="user" autocomplete="username" autocapitalize="none"
        spellcheck=${false} required disabled=${!isSafe} /></label>
      <label>Password <input name="password" type="password" autocomplete="current-password"
        required disabled=${!isSafe} /></label>
      <button disabled=${!isSafe || isBusy}>${isBusy ? 'Signing in …' : 'Sign in'}</button>
      ${!isSafe && html`<p class="notice bad" role="alert">This page came without TLS: a password
        would be read on the way. Open it with https.</p>`}
      ${reason && html`<p class="notice bad" role="alert">${reason}</p>`}
    </form>
    ${name === 'failed' && location.protocol === 'https:' && html`<${Trust} />`}
    ${parts && html`<section><h2>This robot</h2><dl class="facts">${parts.map(([part, state]) => html`
      <div><dt>${part}</dt><dd class=${state === 'not ready' ? 'bad' : ''}>${state}</dd></div>`)}</dl></section>`}
    ${fingerprint && html`<section class="facts"><h2>Fingerprint of its CA</h2>
      <p class="quiet">SHA-256; compare it with what this prints on the robot, in the folder
        of its appliance.yaml:<br />
        <code>openssl x509 -in certs/ca.crt -noout -fingerprint -sha256</code></p>
      <code class="fingerprint">${fingerprint}</code></section>`}
  </main>`
}

function Trust() {
  return html`<section class="facts"><h2>If the connection fails although the page loads</h2>
    <p>The browser does not trust the robot’s certificate for connections yet. Fetch
      <a href="/ca.crt">ca.crt</a>, compare its fingerprint, and trust it:</p>
    <dl>
      <dt>iPhone, iPad</dt><dd>Settings → Profile Downloaded → Install; then General → About →
        Certificate Trust Settings, and switch it on.</dd>
      <dt>Android</dt><dd>Settings → Security → Encryption & credentials → Install a certificate →
        CA certificate.</dd>
      <dt>Desktop</dt><dd>Import it as an authority in the browser’s or the system’s certificates.</dd>
    </dl></section>`
}

async function caFingerprint() {
  if (!globalThis.crypto?.subtle) return ''
  const answer = await fetch('/ca.crt')
  if (!answer.ok) return ''
  const [, body] = (await answer.text()).match(/-----BEGIN CERTIFICATE-----([^-]+)-----END/)
  const der = Uint8Array.from(atob(body.replace(/\s/g, '')), (char) => char.charCodeAt(0))
  const digest = new Uint8Array(await crypto.subtle.digest('SHA-256', der))
  return Array.from(digest, (byte) => byte.toString(16).padStart(2, '0').toUpperCase()).join(':')
}

const READY_WITHIN = 4000 // ms, less than until it is asked again
const PARTS = { mqtt: 'MQTT', store: 'Store', ros: 'ROS', upstream: 'Fleet' }

async function readiness() {
  const answer = await fetch('/readyz', { signal: AbortSignal.timeout(READY_WITHIN) })
  return Object.entries(await answer.json())
    .filter(([part]) => Object.hasOwn(PARTS, part))
    .map(([part, state]) => [PARTS[part], String(state)])
}

// --- overview --------------------------------------------------------------------------------

function Overview() {
  const [parts, setParts] = useState([])
  useEffect(() => {
    const look = () => document.hidden || readiness().then(setParts, () => setParts([]))
    look()
    const timer = setInterval(look, 5000)
    return () => clearInterval(timer)
  }, [])
  const warnings = [...robots.value].flatMap(([robot, about]) => warningsOf(robot, about))
  for (const [part, state] of parts) {
    if (state === 'not ready') warnings.unshift([`${part} is not ready`, ''])
  }
  return html`<h1>Overview</h1>
    <section aria-labelledby="warnings"><h2 id="warnings">Warnings</h2>
      ${warnings.length === 0 ? html`<p class="good">None.</p>` : html`<ul class="warnings">${warnings
    .slice(0, 50).map(([what, why]) => html`<li><strong><bdi>${what}</bdi></strong> ${why}</li>`)}</ul>`}
    </section>
    <section aria-labelledby="state"><h2 id="state">State</h2><dl class="tiles">
      ${parts.map(([part, state]) => html`<div><dt>${part}</dt>
        <dd class=${state === 'not ready' ? 'bad' : ''}>${state}</dd></div>`)}
    </dl><${Later} page="figures" /></section>
    <${Later} page="bridged" />`
}

function warningsOf(robot, { routes = [], skipped }) {
  const found = []
  for (const route of routes) {
    const lost = ['errors', 'lost', 'dropped'].filter((name) => Number.isFinite(route[name]) && route[name] > 0)
    const counts = lost.map((name) => `${route[name]} ${name}`).join(', ')
    if (counts) found.push([route.ros, [counts, route.last_error].filter((part) => typeof part === 'string').join(': ')])
  }
  if (Number.isFinite(skipped?.count) && skipped.count > 0) found.push([robot, `${skipped.count} not bridged`])
  return found
}

resume()
render(html`<${Console} />`, document.getElementById('console'))
