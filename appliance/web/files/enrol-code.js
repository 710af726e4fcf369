// Begin an enrolment: a QR code with which a phone sets the password of its user, once.

import { useEffect, useState } from './vendor/hooks.mjs'
import { shown } from './formats.js'
import { verb } from './link.js'
import { Form, Groups, html, lack, ticked } from './manage.js'

const QUIET = 4 // modules around the code, without which a camera does not find it
const LOOPBACK = /^https?:\/\/(localhost|127(\.\d+){3}|\[::1\])(:|$)/

/** `users` and `groups` are those that are there, null while that is not known. */
export function EnrolPhone({ users, groups, rights }) {
  const [begun, setBegun] = useState(null)
  const [name, setName] = useState('')
  const isThere = users?.some(({ user }) => user === name) ?? false
  const lackingSign = lack(rights, 'certificate_sign')
  const act = async (fields) => {
    setBegun(null)
    const values = { user: name, origin: fields.origin.value.replace(/\/+$/, '') }
    if (!isThere) values.groups = ticked(fields)
    if (fields.certificate.checked) values.certificate = true
    setBegun(await verb('enrol', values))
  }
  return html`
    <p>Shows a QR code. The phone that reads it sets the password of its user and is signed in. It works
      once, and for 10 minutes.</p>
    <${Form} word="Show the code" lacking=${lack(rights, 'enrol') || lack(rights, isThere ? 'user_password' : 'user_add')} act=${act}>
      <label>User name, new or of the list <input name="user" required maxlength="256" autocomplete="off" autocapitalize="none"
        spellcheck=${false} value=${name} onInput=${(event) => setName(event.currentTarget.value)} /></label>
      ${isThere ? html`<p>This user is there: it gets another password, and its other devices will have to know that.</p>`
    : html`<${Groups} all=${groups} of=${[]} />`}
      <div class="ticks"><label><input type="checkbox" name="certificate" disabled=${Boolean(lackingSign)} /> With a certificate of
        its own, for MQTT apps (a .p12 file)</label></div>
      ${lackingSign && lackingSign !== '…' && html`<p class="quiet">A certificate needs <code>${lackingSign}</code></p>`}
      <label>This console, as the phone reaches it <input name="origin" type="url" required maxlength="300"
        defaultValue=${location.origin} /></label>
      ${LOOPBACK.test(location.origin) && html`<p>This page is open by a name that is the phone itself there:
        write the robot’s name or address.</p>`}
    </${Form}>
    ${begun && html`<${Code} key=${begun.url} begun=${begun} />`}`
}

function Code({ begun: { user, url, seconds, qr } }) {
  const [left, setLeft] = useState(seconds)
  useEffect(() => {
    const end = performance.now() + seconds * 1000
    const timer = setInterval(() => setLeft(Math.max(0, Math.ceil((end - performance.now()) / 1000))), 1000)
    return () => clearInterval(timer)
  }, [])
  if (left === 0) return html`<p class="notice" role="status">The code has ended.</p>`
  const side = qr.size + 2 * QUIET
  return html`<figure class="code">
    <svg viewBox=${`${-QUIET} ${-QUIET} ${side} ${side}`} role="img" aria-label="QR code" shape-rendering="crispEdges">
      <rect x=${-QUIET} y=${-QUIET} width=${side} height=${side} fill="#ffffff" /><path d=${qr.path} fill="#000000" /></svg>
    <figcaption>For <bdi>${shown(user)}</bdi>: ${Math.floor(left / 60)}:${String(left % 60).padStart(2, '0')} left. Whoever
      reads it sets the password.<br /><a href=${url} target="_blank" rel="noopener">The same as a link</a></figcaption></figure>`
}
