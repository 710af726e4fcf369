// Certificates of the appliance's own CA: which there are, until when, sign a request, revoke one.

import { useState } from './vendor/hooks.mjs'
import { shown } from './formats.js'
import { verb } from './link.js'
import { Form, Lacking, Problem, Question, Table, html, lack, useAnswer, useRights } from './manage.js'
import { save } from './save.js'

const SOON = 30 // days before an end that is shown as a warning
const LONGEST = 64 * 1024 // bytes of a request
const PURPOSES = { authority: 'CA', server: 'server', client: 'client' }
const HEADS = [['Name', 'main'], ['For', ''], ['State', ''], ['Expires', 'wide'], ['Serial number', 'wide'], ['', 'wide']]

export function Certificates() {
  const rights = useRights(['certificates', 'certificate_sign', 'certificate_revoke'])
  const [isAll, setAll] = useState(false)
  const [after, setAfter] = useState(0)
  const { answer, error, again } = useAnswer('certificates', lack(rights, 'certificates') ? null : { all: isAll, after })
  const [revoked, revoke] = useState(null)
  const mayNot = Boolean(lack(rights, 'certificate_revoke'))
  return html`
    <${Lacking} rights=${rights} of=${[['certificates', 'See them'], ['certificate_sign', 'Sign a request'],
    ['certificate_revoke', 'Revoke one']]} />
    <${Problem} words=${error} />
    ${answer && html`
      <div class="tools"><button aria-pressed=${isAll} onClick=${() => { setAll(!isAll); setAfter(0) }}>
        Expired and replaced ones too</button></div>
      <${Table} label="Certificates" heads=${HEADS} rows=${answer.certificates.map((each) => ({
    key: each.serial,
    cells: [
      html`<bdi>${shown(each.name)}</bdi>`,
      PURPOSES[each.for] ?? each.for,
      html`<span class=${each.state === 'valid' ? 'good' : 'bad'}>${each.state}</span>`,
      html`<span class=${each.state === 'valid' && each.days < SOON ? 'bad' : ''}>${each.expires.slice(0, 10)}${each.state === 'valid'
        ? `, in ${each.days} days` : ''}</span>`,
      html`<code>${each.serial}</code>`,
      each.for === 'client' && each.state === 'valid' ? html`<button disabled=${mayNot}
        aria-label=${`Revoke ${shown(each.name)}`} onClick=${() => revoke(each)}>Revoke …</button>` : null,
    ],
  }))} />
      ${answer.next !== null && html`<button onClick=${() => setAfter(answer.next)}>Next</button>`}`}
    <details><summary>Sign a request</summary><${Sign} rights=${rights} signed=${again} /></details>
    ${revoked && html`<${Question} title="Revoke this certificate?" word="Revoke" done=${again}
      act=${() => verb('certificate_revoke', { certificate: revoked.serial })} close=${() => revoke(null)}>
      <p>Whoever has the certificate <bdi>${shown(revoked.name)}</bdi> cannot log in with it any more. This
        cannot be undone.</p></${Question}>`}`
}

function Sign({ rights, signed }) {
  const [made, setMade] = useState(null)
  const act = async (fields) => {
    setMade(null)
    const [file] = fields.file.files
    if (file && file.size > LONGEST) throw new Error('This file is no request: it is too large.')
    const request = file ? await file.text() : fields.request.value
    if (!request.trim()) throw new Error('Choose a file, or paste the request.')
    const values = { request }
    if (fields.name.value) values.name = fields.name.value
    setMade(await verb('certificate_sign', values))
    signed()
    return 'It is signed.'
  }
  const keep = (text, name) => () => save(new Blob([text], { type: 'application/x-pem-file' }), name)
  return html`<p class="quiet">The key stays on the device, which makes the request with
      ${' '}<code>openssl req -new -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout key.pem -out request.pem</code>.</p>
    <${Form} word="Sign" lacking=${lack(rights, 'certificate_sign')} act=${act}>
      <label>File <input name="file" type="file" accept=".pem,.csr,.req" /></label>
      <label>or the request itself (PEM) <textarea name="request" rows="4" maxlength=${LONGEST} spellcheck=${false}></textarea></label>
      <label>Name, if not that of the request <input name="name" maxlength="256" autocomplete="off"
        autocapitalize="none" spellcheck=${false} /></label></${Form}>
    ${made && html`<div class="tools"><button onClick=${keep(made.certificate, `${made.name}.crt`)}>Save ${shown(made.name)}.crt</button>
      <button onClick=${keep(made.ca, 'ca.crt')}>Save ca.crt</button></div>`}`
}
