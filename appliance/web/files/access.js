// Who may do what: users and their groups, why somebody may not, certificates.

import { useState } from './vendor/hooks.mjs'
import { counted, shown } from './formats.js'
import { user as self, verb } from './link.js'
import { Form, Groups, Lacking, Problem, Question, Table, Tabs, html, lack, ticked, useAnswer, useRights } from './manage.js'
import { EnrolPhone } from './enrol-code.js'
import { Certificates } from './certificates.js'

const PARTS = [['users', 'Users'], ['explain', 'Explain'], ['certificates', 'Certificates']]
const SHOWN = 200 // users of a list
const LONGEST = 256 // characters of a user's name
const PASSWORD = 1024 // characters

export default function Access({ topic }) {
  const part = PARTS.some(([key]) => key === topic) ? topic : 'users'
  return html`<h1>Access</h1><${Tabs} page="access" parts=${PARTS} shown=${part} />
    ${part === 'users' ? html`<${Users} />` : part === 'explain' ? html`<${Explain} />` : html`<${Certificates} />`}`
}

const USERS = ['users', 'user_add', 'user_password', 'user_remove', 'user_groups', 'enrol', 'certificate_sign']

function Users() {
  const rights = useRights(USERS)
  const { answer, error, again } = useAnswer('users', lack(rights, 'users') ? null : {})
  const [sought, seek] = useState('')
  const [chosen, choose] = useState(null)
  const found = (answer?.users ?? []).filter(({ user }) => user.toLowerCase().includes(sought.toLowerCase()))
  const one = answer?.users.find(({ user }) => user === chosen)
  return html`
    <${Lacking} rights=${rights} of=${[['users', 'See the users'], ['user_add', 'Add one'],
    ['user_password', 'Change a password'], ['user_groups', 'Change groups'], ['user_remove', 'Remove one'], ['enrol', 'Enrol a phone']]} />
    <${Problem} words=${error} />
    ${answer && html`
      <div class="tools"><input type="search" aria-label="Search users" placeholder="Search" value=${sought}
        onInput=${(event) => seek(event.currentTarget.value)} /></div>
      <${Table} label="Users" heads=${[['User', 'main'], ['Password', 'wide'], ['Groups', 'wide'], ['', 'wide']]}
        rows=${found.slice(0, SHOWN).map(({ user, kind, groups }) => ({
    key: user,
    cells: [
      html`<bdi>${shown(user)}</bdi>${user === self.value ? ' (this is you)' : ''}`,
      kind,
      groups.join(', ') || 'none',
      html`<button aria-expanded=${user === chosen} aria-label=${`Change ${shown(user)}`}
        onClick=${() => choose(user === chosen ? null : user)}>Change</button>`,
    ],
  }))} />
      <p class="quiet" role="status">${counted(found.length, 'user')}${found.length > SHOWN ? `, the first ${SHOWN}` : ''}</p>
      ${one && html`<${User} key=${one.user} one=${one} groups=${answer.groups} rights=${rights}
        changed=${again} close=${() => choose(null)} />`}`}
    <details><summary>Add a user</summary><${Add} groups=${answer?.groups ?? null} rights=${rights} changed=${again} /></details>
    <details><summary>Enrol a phone</summary><${EnrolPhone} users=${answer?.users ?? null} groups=${answer?.groups ?? null}
      rights=${rights} /></details>`
}

function Password() {
  return html`<label>Password <input name="password" type="password" autocomplete="new-password" required
    maxlength=${PASSWORD} /></label>`
}

function Add({ groups, rights, changed }) {
  const act = async (fields) => {
    const user = fields.user.value
    await verb('user_add', { user, password: fields.password.value, groups: ticked(fields) })
    changed()
    return `${shown(user)} is there.`
  }
  return html`<${Form} word="Add" lacking=${lack(rights, 'user_add')} act=${act}>
    <label>User name <input name="user" required maxlength=${LONGEST} autocomplete="off" autocapitalize="none"
      spellcheck=${false} /></label>
    <${Password} /><${Groups} all=${groups} of=${[]} /></${Form}>`
}

function User({ one: { user, groups: own }, groups, rights, changed, close }) {
  const [isAsked, ask] = useState(false)
  const setGroups = async (fields) => {
    await verb('user_groups', { user, groups: ticked(fields) })
    changed()
    return 'The groups are changed.'
  }
  const setPassword = async (fields) => {
    await verb('user_password', { user, password: fields.password.value })
    changed()
    return 'The password is changed.'
  }
  return html`<section class="inspector" aria-labelledby="one">
    <div class="tools"><h2 id="one"><bdi>${shown(user)}</bdi></h2><button onClick=${close}>Close</button></div>
    <${Form} word="Set groups" lacking=${lack(rights, 'user_groups')} act=${setGroups}>
      <${Groups} key=${own.join()} all=${groups} of=${own} /></${Form}>
    <${Form} word="Change password" lacking=${lack(rights, 'user_password')} act=${setPassword}><${Password} /></${Form}>
    <button class="danger" disabled=${Boolean(lack(rights, 'user_remove'))} onClick=${() => ask(true)}>Remove …</button>
    ${isAsked && html`<${Question} title="Remove this user?" word="Remove" act=${() => verb('user_remove', { user })}
      done=${() => { close(); changed() }} close=${() => ask(false)}>
      <p><bdi>${shown(user)}</bdi> cannot log in any more, and its clients are disconnected.
        ${user === self.value ? ' This is you: you will be signed out.' : ''}</p></${Question}>`}
  </section>`
}

const ACTIONS = { publish: 'Publish', subscribe: 'Subscribe', receive: 'Receive' }

function Explain() {
  const rights = useRights(['explain'])
  const [told, tell] = useState(null)
  const act = async (fields) => {
    tell(null)
    const values = { user: fields.user.value || null, topic: fields.topic.value, client: fields.client.value }
    const [user, topic] = [fields.user.value, fields.topic.value]
    tell(await verb('explain', values))
    fields.user.defaultValue = user // for the next topic of the same user
    fields.topic.defaultValue = topic
  }
  return html`<p>May a user do something with a topic, and which rule decides?</p>
    <${Lacking} rights=${rights} of=${[['explain', 'Ask']]} />
    <${Form} word="Explain" lacking=${lack(rights, 'explain')} act=${act}>
      <label>User name (nothing for clients without one) <input name="user" maxlength=${LONGEST} autocomplete="off"
        autocapitalize="none" spellcheck=${false} /></label>
      <label>Topic, or filter with + and # <input name="topic" required autocomplete="off" autocapitalize="none"
        spellcheck=${false} /></label>
      <label>Client id, for rules with %c <input name="client" autocomplete="off" autocapitalize="none"
        spellcheck=${false} /></label></${Form}>
    ${told && html`<section aria-live="polite"><h2><bdi>${told.user === null ? 'without a user' : shown(told.user)}</bdi>,
      <bdi> ${shown(told.topic)}</bdi></h2>
      <dl class="verdicts">${told.verdicts.map((verdict) => html`<div key=${verdict.action}>
        <dt>${ACTIONS[verdict.action] ?? verdict.action}: <strong class=${verdict.allowed ? 'good' : 'bad'}>
          ${verdict.allowed ? 'allowed' : 'refused'}</strong></dt>
        <dd><bdi>${shown(verdict.reason, 2000)}</bdi>
          ${verdict.included_by.length > 0 && html`<br />included by ${verdict.included_by.map((each) => shown(each, 500)).join(', then ')}`}
          ${verdict.line && html`<br />This line below the user would allow it: <code>${shown(verdict.line, 2000)}</code>`}
          ${verdict.passed_over_count > 0 && html`<details><summary>${verdict.passed_over_count} rules do not apply</summary>
            <ul>${verdict.passed_over.map((each) => html`<li key=${each}><bdi>${shown(each, 500)}</bdi></li>`)}</ul></details>`}
        </dd></div>`)}</dl></section>`}`
}
