// Pictures of a camera at a rate that is chosen; none are sent while nobody sees them.

import { h } from './vendor/preact.mjs'
import { useEffect, useRef, useState } from './vendor/hooks.mjs'
import { signal } from './vendor/signals.mjs'
import htm from './vendor/htm.mjs'
import { routesOf, useWatch } from './live.js'
import { save } from './save.js'

const html = htm.bind(h)

const IMAGE = /^sensor_msgs(\/msg)?\/Image$/
const COMPRESSED = /^sensor_msgs(\/msg)?\/CompressedImage$/
const READ = ['json', 'cbor', 'cdr', 'binary'] // the encodings of which a CompressedImage is read
const RATES = [1, 2, 5, 10, 15, 30]
const OLD = 3 // seconds without a picture, and five intervals, after which that is said

const rate = signal(5)

/** The routes that carry pictures, with what speaks against showing them. */
function cameras() {
  return routesOf(({ type, encoding }) => IMAGE.test(type) || COMPRESSED.test(type)
    || encoding === 'jpeg' || encoding === 'png').map((route) => {
    const { mqtt, type, encoding } = route
    let obstacle = ''
    if (COMPRESSED.test(type)) {
      if (!READ.includes(encoding)) obstacle = `This route sends ${encoding}; the console reads ${READ.join(', ')}.`
    } else if (encoding !== 'jpeg' && encoding !== 'png') {
      obstacle = `This route sends the pixels as ${encoding}. With encoding: jpeg in appliance.yaml it sends pictures.`
    }
    const problem = route.errors > 0 && typeof route.last_error === 'string' ? route.last_error : ''
    return { mqtt, obstacle, problem }
  })
}

export default function Camera({ topic }) {
  const found = cameras()
  const chosen = topic || (found.find(({ obstacle }) => !obstacle) ?? found[0])?.mqtt
  if (chosen === undefined) {
    return html`<h1>Camera</h1><p class="notice">No route with pictures is known: none is bridged with
      encoding: jpeg or png, and no CompressedImage, or this user may not read {robot}/_appliance/routes.</p>`
  }
  const route = found.find(({ mqtt }) => mqtt === chosen) ?? { mqtt: chosen, obstacle: '', problem: '' }
  const topics = found.includes(route) ? found : [route, ...found]
  return html`<h1>Camera</h1>
    <div class="choices">
      <label>Topic <select value=${chosen} onChange=${(event) => {
        location.hash = `#/camera/${encodeURIComponent(event.currentTarget.value)}`
      }}>${topics.map(({ mqtt }) => html`<option key=${mqtt} value=${mqtt}>${mqtt}</option>`)}</select></label>
      <label>Pictures a second, at most <select value=${rate.value} onChange=${(event) => {
        rate.value = Number(event.currentTarget.value)
      }}>${RATES.map((each) => html`<option key=${each} value=${each}>${each}</option>`)}</select></label>
    </div>
    ${route.obstacle && html`<p class="notice bad" role="alert">${route.obstacle}</p>`}
    ${route.problem && html`<p class="notice">The bridge had an error: <bdi>${route.problem}</bdi></p>`}
    <${Pictures} key=${chosen} topic=${chosen} isPossible=${!route.obstacle} />`
}

const NOTHING = { reason: '', problem: '', last: null, frames: [], skipped: 0, began: 0 }

function Pictures({ topic, isPossible }) {
  const canvas = useRef(null)
  const seen = useRef({ ...NOTHING })
  const [isPaused, pause] = useState(false)
  const [, draw] = useState(0)
  const isOn = isPossible && !isPaused
  useEffect(() => {
    seen.current = { ...seen.current, frames: [], began: Date.now() }
    const timer = setInterval(() => draw((count) => count + 1), 500)
    return () => clearInterval(timer)
  }, [isOn])
  useWatch(isOn ? { kind: 'camera', topic, rate: rate.value } : null, (told) => {
    const now = seen.current
    const isNews = now.reason !== told.reason || now.problem !== told.problem
    now.reason = told.reason
    if (told.at) now.problem = told.problem
    if (told.bitmap) {
      show(canvas.current, told.bitmap)
      const { width, height } = told.bitmap
      now.last = { at: told.at, size: told.size, width, height }
      now.skipped = told.skipped
      now.frames = [...now.frames, performance.now()].filter((at) => at > performance.now() - 3000)
      told.bitmap.close()
    }
    if (isNews || now.frames.length === 1) draw((count) => count + 1)
  })
  const { reason, problem, last, frames, skipped, began } = seen.current
  const age = last === null ? null : (Date.now() - last.at) / 1000
  const silence = (Date.now() - Math.max(last?.at ?? 0, began)) / 1000
  const isOld = isOn && silence > Math.max(OLD, 5 / rate.value)
  const keep = () => canvas.current.toBlob((blob) => blob && save(blob, `${topic}.png`))
  return html`
    ${reason && html`<p class="notice bad" role="alert">${reason}</p>`}
    ${problem && html`<p class="notice bad" role="alert">The last picture could not be shown: ${problem}</p>`}
    ${isOld && !reason && !problem && html`<p class="notice bad" role="alert">${last === null
      ? 'No picture has come yet.' : 'No picture comes any more; this one is old.'}</p>`}
    <div class="tools">
      <button aria-pressed=${isPaused} disabled=${!isPossible} onClick=${() => pause(!isPaused)}>
        ${isPaused ? 'Continue' : 'Pause'}</button>
      <button disabled=${last === null} onClick=${keep}>Save the picture</button>
    </div>
    <canvas class=${`video ${isOld || isPaused || problem ? 'old' : ''}`} ref=${canvas} width="640" height="360" role="img"
      aria-label=${`Picture of ${topic}`} />
    <dl class="tiles">
      <div><dt>Pictures a second</dt><dd>${isOn ? rateOf(frames) : 'paused'}</dd></div>
      <div><dt>Age</dt><dd class=${isOld ? 'bad' : ''}>${age === null ? 'none' : `${age.toFixed(1)} s`}</dd></div>
      <div><dt>Size</dt><dd>${last === null ? 'none' : `${last.width} × ${last.height}`}</dd></div>
      <div><dt>Bytes</dt><dd>${last === null ? 'none' : `${(last.size / 1024).toFixed(1)} KiB`}</dd></div>
      <div><dt>Skipped here</dt><dd>${skipped}</dd></div>
    </dl>
    <p class="quiet">The age is counted from when the picture came to this device. Nothing is sent while the page is
      hidden or left.</p>`
}

function show(element, bitmap) {
  if (element.width !== bitmap.width || element.height !== bitmap.height) {
    element.width = bitmap.width
    element.height = bitmap.height
  }
  element.getContext('2d', { alpha: false }).drawImage(bitmap, 0, 0)
}

function rateOf(frames) {
  const recent = frames.filter((at) => at > performance.now() - 3000)
  if (recent.length < 2) return 'less than 1'
  return ((recent.length - 1) * 1000 / (recent.at(-1) - recent[0])).toFixed(1)
}
