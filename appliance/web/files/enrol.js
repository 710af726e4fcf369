// A phone that has read the QR code: its user chooses a password, is signed in, and sees what apps need.

import { useEffect, useState } from './vendor/hooks.mjs'
import { shown } from './formats.js'
import { session, signIn } from './link.js'
import { Form, html } from './manage.js'

const LETTERS = 'abcdefghijkmnpqrstuvwxyz23456789' // 32, of which none looks like another
const LENGTH = 16

export default function Enrol({ topic }) {
  const [[code, name]] = useState(() => {
    const [first, ...rest] = topic.split('/')
    return [first, rest.join('/')]
  })
  const [password] = useState(newPassword)
  const [done, setDone] = useState(null)
  // Not in the history: the code is worth a password until it is used.
  useEffect(() => { history.replaceState(null, '', '#/enrol') }, [])
  const act = async (fields) => {
    const chosen = fields.password.value
    const { user, mqtt_port: port, p12, problem } = await exchange(code, chosen)
    // Else this page would have in its memory what another user has seen.
    const isOthers = ['in', 'lost'].includes(session.peek().name)
    setDone({ user, port, password: chosen, url: p12 && download(p12), problem, isOthers })
    if (!isOthers) signIn(user, chosen).catch(() => {})
  }
  return html`<main class="sign-in"><h1>${location.hostname}</h1>
    ${done !== null ? html`<${Done} done=${done} />` : !code ? html`<p class="notice bad" role="alert">The code is not
      in the address any more: read the QR code again.</p>` : html`
      <p>This phone gets a password for this robot${name ? html` as <strong><bdi>${shown(name)}</bdi></strong>` : ''}. Keep the
        one below, or choose another.</p>
      <${Form} word="Set it and sign in" act=${act}>
        <input name="user" autocomplete="username" value=${name} readonly hidden />
        <label>Password <input name="password" autocomplete="new-password" autocapitalize="none" spellcheck=${false}
          required maxlength="1024" defaultValue=${password} /></label></${Form}>`}
  </main>`
}

function Done({ done: { user, port, password, url, problem, isOthers } }) {
  const { name, reason } = session.value
  return html`<p class="good" role="status">The password is set. Keep it: it is not shown again.</p>
    ${isOthers && html`<p class="notice">This window stays signed in as another user.</p>`}
    ${name === 'in' ? html`<p><a class="button" href="#/overview">To the console</a></p>`
    : html`<p class=${reason ? 'notice bad' : 'quiet'}>${reason || 'Signing in …'}</p>`}
    <section class="facts"><h2>For MQTT apps</h2><dl class="properties">
      <div><dt>host</dt><dd>${location.hostname}</dd></div>
      <div><dt>port (TLS)</dt><dd>${port ?? 'none'}</dd></div>
      <div><dt>user</dt><dd><bdi>${shown(user, 2000)}</bdi></dd></div>
      <div><dt>password</dt><dd><code>${password}</code></dd></div>
      <div><dt>CA</dt><dd><a href="/ca.crt">ca.crt</a></dd></div>
      ${url && html`<div><dt>certificate</dt><dd><a href=${url} download=${`${user}.p12`}><bdi>${shown(user)}</bdi>.p12</a>, which this
        password opens; it is on no other device, and not shown again</dd></div>`}
    </dl>${problem ? html`<p class="notice bad">There is no certificate: ${problem}</p>`
    : !url && html`<p class="quiet">An app that wants a certificate of its own makes a request, which an admin signs.</p>`}</section>`
}

function download(base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0))
  return URL.createObjectURL(new Blob([bytes], { type: 'application/x-pkcs12' }))
}

function newPassword() {
  const random = crypto.getRandomValues(new Uint8Array(LENGTH))
  return Array.from(random, (byte, index) => (index && index % 4 === 0 ? '-' : '') + LETTERS[byte % 32]).join('')
}

async function exchange(code, password) {
  const bytes = new TextEncoder().encode(`${code}:${password}`)
  const answer = await fetch('/enrol', {
    method: 'POST',
    credentials: 'omit',
    headers: { Authorization: `Basic ${btoa(String.fromCharCode(...bytes))}` },
  })
  if (!answer.ok) throw new Error((await answer.text()).trim() || `error ${answer.status}`)
  return answer.json()
}
