// Hold to drive. Whatever ends the hold stops the robot: release, cancel, blur, a hidden page, a
// turned phone. A button that is only pressed once drives nothing.

import { h } from './vendor/preact.mjs'
import { useEffect, useRef, useState } from './vendor/hooks.mjs'
import htm from './vendor/htm.mjs'
import { drive, robot, robots, tell } from './link.js'

const html = htm.bind(h)

const TWIST = /^geometry_msgs(\/msg)?\/Twist(Stamped)?$/
const CAUTIOUS = { 'linear.x': 0.2, 'angular.z': 0.5 } // m/s and rad/s where the route has no clamp
const DEAD_MAN = [4, 5] // the gamepad's shoulder buttons
const FROZEN = 2000 // ms without a beat, of ten a second: the page, or the whole device, was held up

/**
 * The routes that take a Twist, with what speaks against driving by each. Only those of this robot: who
 * may write another's topics may publish routes there, with rules that they have not.
 */
function drivable() {
  const found = []
  for (const route of robots.value.get(robot)?.routes ?? []) {
    if (route?.direction !== 'to_ros' || !TWIST.test(route.type)) continue
    const isStamped = route.type.endsWith('Stamped')
    const rules = route.rules ?? {}
    let obstacle = ''
    if (rules.on_silence == null) {
      obstacle = 'This route has no on_silence in appliance.yaml: the robot would not stop if this device went away.'
    } else if (route.encoding !== 'json') {
      obstacle = `This route takes ${route.encoding}; the console drives with JSON.`
    }
    const limit = (field) => bounds(rules.clamp, isStamped ? `twist.${field}` : field, CAUTIOUS[field])
    found.push({
      mqtt: route.mqtt,
      isStamped,
      obstacle,
      commanding: rules.commanding ?? null,
      linear: limit('linear.x'),
      angular: limit('angular.z'),
      isClamped: Boolean(rules.clamp && Object.keys(rules.clamp).length),
    })
  }
  return found
}

function bounds(clamp, field, otherwise) {
  const found = clamp && Object.hasOwn(clamp, field) ? clamp[field] : null
  const isRange = Array.isArray(found) && found.every(Number.isFinite)
  return isRange ? [Math.min(0, found[0]), Math.max(0, found[1])] : [-otherwise, otherwise]
}

/** Part of the way from 0 to a bound: -1 to 1. */
function scaled(part, [low, high], share) {
  return (part < 0 ? -part * low : part * high) * share
}

export default function Drive() {
  const found = drivable()
  const [chosen, choose] = useState('')
  const first = (found.find(({ obstacle }) => !obstacle) ?? found[0])?.mqtt ?? ''
  // The one that was shown stays the one: who holds a button does not mean another machine.
  useEffect(() => { if (!chosen) choose(first) }, [chosen, first])
  const route = found.find(({ mqtt }) => mqtt === (chosen || first))
  if (found.length === 0) {
    return html`<h1>Drive</h1><p class="notice">No route to ROS of type geometry_msgs/msg/Twist or
      TwistStamped is known. It may not be bridged, or this user may not read {robot}/_appliance/routes.</p>`
  }
  return html`<h1>Drive</h1>
    ${(found.length > 1 || !route) && html`<label>Route <select value=${route?.mqtt ?? ''} onChange=${(event) => choose(event.currentTarget.value)}>
      ${!route && html`<option value="">Choose one</option>`}
      ${found.map(({ mqtt }) => html`<option key=${mqtt} value=${mqtt}>${mqtt}</option>`)}</select></label>`}
    ${route ? html`<${Control} key=${route.mqtt} route=${route} />`
    : html`<p class="notice bad" role="alert"><bdi>${chosen}</bdi> is not bridged now.</p>`}`
}

function Control({ route }) {
  const told = drive.value
  const [share, setShare] = useState(0.5)
  const [speed, setSpeed] = useState([0, 0])
  const [holding, setHolding] = useState('')
  const pad = useRef(null)
  const now = useRef(null)
  now.current = { route, share }

  useEffect(() => {
    if (route.obstacle) return undefined
    const hold = new Hold(now, setSpeed, setHolding)
    const element = pad.current
    const { mqtt, isStamped } = route
    const prepare = () => document.hidden || tell('ready', { route: { mqtt, isStamped } })
    const hidden = () => {
      hold.release()
      if (document.hidden) tell('leave')
      else prepare()
    }
    prepare()
    const release = () => hold.release()
    const listeners = [
      [element, 'pointerdown', (event) => hold.pointerDown(event, element)],
      [element, 'pointermove', (event) => hold.pointerMove(event, element)],
      ...['pointerup', 'pointercancel', 'lostpointercapture', 'blur', 'contextmenu'].map((name) => [element, name, (event) => {
        if (name === 'contextmenu') event.preventDefault()
        hold.release()
      }]),
      [element, 'keydown', (event) => hold.keyDown(event)],
      [element, 'keyup', (event) => hold.keyUp(event)],
      [window, 'blur', release],
      [window, 'pagehide', release],
      [window, 'hashchange', release],
      [window, 'orientationchange', release],
      [screen.orientation ?? window, 'change', release],
      [document, 'visibilitychange', hidden],
    ]
    for (const [target, name, listener] of listeners) target.addEventListener(name, listener)
    hold.start()
    return () => {
      for (const [target, name, listener] of listeners) target.removeEventListener(name, listener)
      hold.end()
      tell('leave')
    }
  }, [route.mqtt, route.isStamped, route.obstacle])

  const words = route.obstacle || told?.reason || ''
  const [linear, angular] = speed
  return html`
    ${words && html`<p class="notice bad" role="alert">${words}</p>`}
    <p class="quiet">${route.commanding ? html`Commanding now: <strong><bdi>${
    route.commanding === told?.driver ? 'you' : route.commanding}</bdi></strong>` : ''}
      ${!route.isClamped && ' The route has no clamp, so the speeds are cautious ones.'}</p>
    <label class="share">Speed: ${Math.round(share * 100)} % of the limits
      <input type="range" min="0.1" max="1" step="0.1" value=${share} disabled=${Boolean(route.obstacle)}
        onInput=${(event) => setShare(Number(event.currentTarget.value))} /></label>
    <div class=${`pad ${holding ? 'held' : ''}`} ref=${pad} tabindex="0" role="application"
      aria-disabled=${Boolean(route.obstacle)} aria-label="Hold to drive: up and down for speed, left and right to turn; or hold the arrow keys">
      <span class="up" aria-hidden="true">▲</span><span class="down" aria-hidden="true">▼</span>
      <span class="left" aria-hidden="true">◀</span><span class="right" aria-hidden="true">▶</span>
      <span class="hint">${route.obstacle ? 'Not possible' : holding ? (words ? 'Not driving' : `Driving by ${holding}`) : 'Hold to drive'}</span>
    </div>
    <dl class="tiles" aria-live="off">
      <div><dt>Forward</dt><dd>${linear.toFixed(2)} m/s</dd></div>
      <div><dt>Turn</dt><dd>${angular.toFixed(2)} rad/s</dd></div>
      <div><dt>Connection</dt><dd>${told?.state ?? 'none'}</dd></div>
      <div><dt>Refused</dt><dd>${told?.refused ?? 0}</dd></div>
    </dl>
    <p class="quiet">Keys: hold the arrows or W, A, S, D while the field has the focus. Gamepad: hold a shoulder
      button, steer with the left stick. Letting go stops the robot.</p>`
}

const KEYS = {
  ArrowUp: [1, 0], KeyW: [1, 0], ArrowDown: [-1, 0], KeyS: [-1, 0],
  ArrowLeft: [0, 1], KeyA: [0, 1], ArrowRight: [0, -1], KeyD: [0, -1],
}

/** What holds the robot in motion: a pointer, keys, or a gamepad; one of them at a time. */
class Hold {
  constructor(now, setSpeed, setHolding) {
    this.now = now
    this.setSpeed = setSpeed
    this.setHolding = setHolding
    this.by = ''
    this.parts = [0, 0]
    this.sent = 0
    this.keys = new Set()
    this.pointer = null
    this.isFree = false // whether the dead-man button was seen open: one that is held already drives nothing
  }

  start() {
    const step = () => {
      this.gamepad()
      if (this.by) this.send()
      this.frame = requestAnimationFrame(step)
    }
    this.frame = requestAnimationFrame(step)
    this.beat = setInterval(() => { if (this.by) this.send() }, 100)
  }

  end() {
    this.release()
    cancelAnimationFrame(this.frame)
    clearInterval(this.beat)
  }

  take(by, forward, left) {
    if (this.by && this.by !== by) return
    if (document.hidden) return
    if (!this.by) this.sent = Date.now()
    this.by = by
    this.parts = [forward, left]
    this.setHolding(by)
    this.send()
  }

  send() {
    const now = Date.now() // which counts while a device sleeps
    if (now - this.sent > FROZEN) {
      this.release() // whether it is held still, a page that was frozen cannot know
      return
    }
    this.sent = now
    const { route, share } = this.now.current
    const linear = scaled(this.parts[0], route.linear, share)
    const angular = scaled(this.parts[1], route.angular, share)
    this.setSpeed([linear, angular])
    tell('go', { linear, angular })
  }

  release() {
    this.keys.clear()
    this.pointer = null
    this.isFree = false // the button has to be let go and pressed again
    if (!this.by) return
    this.by = ''
    tell('stop')
    this.setHolding('')
    this.setSpeed([0, 0])
  }

  pointerDown(event, element) {
    if (this.pointer !== null || event.button !== 0) {
      this.release() // a second finger is no steering
      return
    }
    this.pointer = event.pointerId
    element.setPointerCapture(event.pointerId)
    element.focus({ preventScroll: true })
    this.steer(event, element)
  }

  pointerMove(event, element) {
    if (event.pointerId !== this.pointer) return
    if (!(event.buttons & 1)) this.release() // where others are held, there is no pointerup for the first
    else this.steer(event, element)
  }

  steer(event, element) {
    const box = element.getBoundingClientRect()
    const part = (at, from, length) => {
      const found = Math.max(-1, Math.min(1, ((at - from) / length) * 2 - 1))
      return Math.abs(found) < 0.1 ? 0 : found
    }
    const x = part(event.clientX, box.left, box.width)
    const y = part(event.clientY, box.top, box.height)
    this.take(event.pointerType || 'touch', -y || 0, -x || 0)
  }

  keyDown(event) {
    // With Cmd held, macOS tells nobody that another key is let go.
    const isModified = event.ctrlKey || event.altKey || event.metaKey
    if (event.code === 'Escape' || isModified) this.release()
    if (!Object.hasOwn(KEYS, event.code) || isModified) return
    event.preventDefault()
    if (event.repeat && !this.keys.has(event.code)) return // held since before a stop
    this.keys.add(event.code)
    this.steerByKeys()
  }

  keyUp(event) {
    if (!this.keys.delete(event.code)) return
    if (this.keys.size) this.steerByKeys()
    else this.release()
  }

  steerByKeys() {
    const sum = [...this.keys].map((code) => KEYS[code])
    const part = (index) => Math.max(-1, Math.min(1, sum.reduce((total, each) => total + each[index], 0)))
    this.take('keys', part(0), part(1))
  }

  /** Browsers tell of gamepads in windows without the focus, too: only the one with it drives. */
  gamepad() {
    const pads = document.hasFocus() ? [...(navigator.getGamepads?.() ?? [])].filter((each) => each?.connected) : []
    const pad = pads.find(({ buttons }) => DEAD_MAN.some((button) => buttons[button]?.pressed))
    if (pad === undefined) {
      if (this.by === 'gamepad') this.release()
      if (pads.length > 0) this.isFree = true
      return
    }
    if (!this.isFree) return
    const part = (axis) => (Math.abs(axis) < 0.12 ? 0 : -axis)
    this.take('gamepad', part(pad.axes[1] ?? 0), part(pad.axes[0] ?? 0))
  }
}
