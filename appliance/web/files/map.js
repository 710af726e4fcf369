// The map that the robot has, where it is on it, and what its scanner sees.

import { h } from './vendor/preact.mjs'
import { useEffect, useRef, useState } from './vendor/hooks.mjs'
import htm from './vendor/htm.mjs'
import { routesOf, useWatch } from './live.js'
import { arranged } from './arrange.js'
import { MapCanvas } from './map-canvas.js'

const html = htm.bind(h)

const CLOUD = /^sensor_msgs(\/msg)?\/PointCloud2$/
const PARTS = [
  ['grid', 'Map', /^nav_msgs(\/msg)?\/OccupancyGrid$/],
  ['pose', 'Pose', /^(nav_msgs(\/msg)?\/Odometry|geometry_msgs(\/msg)?\/PoseStamped|geometry_msgs(\/msg)?\/PoseWithCovarianceStamped)$/],
  ['scan', 'Scan', /^sensor_msgs(\/msg)?\/(LaserScan|PointCloud2)$/],
]
const TF = /^(tf2_msgs(\/msg)?\/TFMessage|tf\/tfMessage)$/
const MOST_TF = 8 // topics
const NONE = '-' // which is no MQTT topic of a route

/** Of each part the routes that carry it. */
function found() {
  return Object.fromEntries(PARTS.map(([part, , types]) => [part, routesOf(({ type }) => types.test(type))]))
}

/** The topics with transforms of the robots that these topics are of: [topic, whether they are static] each. */
function transformsOf(topics) {
  const wanted = Object.values(topics)
  const of = new Set(routesOf(({ mqtt }) => wanted.includes(mqtt)).map(({ robot }) => robot))
  return routesOf((route) => of.has(route.robot) && TF.test(route.type) && isRead(route))
    .slice(0, MOST_TF).map(({ mqtt, ros }) => [mqtt, /static$/.test(ros)])
}

const isRead = ({ encoding }) => encoding === 'json' || encoding === 'cbor'

export default function MapPage() {
  const routes = found()
  const [chosen, choose] = useState({})
  const topics = {}
  const obstacles = []
  let isCloud = false
  for (const [part, label] of PARTS) {
    const route = routes[part].find(({ mqtt }) => mqtt === chosen[part])
      ?? (chosen[part] === NONE ? undefined : routes[part].find(isRead) ?? routes[part][0])
    if (route === undefined) continue
    if (isRead(route)) topics[part] = route.mqtt
    else obstacles.push(`${label}: ${route.mqtt} goes as ${route.encoding}; the console reads json and cbor.`)
    if (part === 'scan') isCloud = CLOUD.test(route.type)
  }
  if (PARTS.every(([part]) => routes[part].length === 0)) {
    return html`<h1>Map</h1><p class="notice">No route of a map (nav_msgs/msg/OccupancyGrid), a pose (Odometry, PoseStamped,
      PoseWithCovarianceStamped) or a scan (LaserScan, PointCloud2) is known. They may not be bridged, or this user may not
      read {robot}/_appliance/routes.</p>`
  }
  const tf = transformsOf(topics)
  return html`<h1>Map</h1>
    <div class="choices">${PARTS.map(([part, label]) => html`
      <label key=${part}>${label} <select value=${topics[part] ?? NONE} disabled=${routes[part].length === 0}
        onChange=${(event) => choose({ ...chosen, [part]: event.currentTarget.value })}>
        <option value=${NONE}>none</option>
        ${routes[part].map(({ mqtt }) => html`<option key=${mqtt} value=${mqtt}>${mqtt}</option>`)}</select></label>`)}
    </div>
    ${obstacles.map((obstacle) => html`<p class="notice bad" role="alert">${obstacle}</p>`)}
    <${View} key=${JSON.stringify([topics, tf])} topics=${topics} isCloud=${isCloud} tf=${tf} />`
}

function View({ topics, isCloud, tf }) {
  const canvas = useRef(null)
  const map = useRef(null)
  const seen = useRef({ reason: '', parts: {}, problems: {} })
  const [follows, follow] = useState(false)
  const [, draw] = useState(0)
  useEffect(() => {
    map.current = new MapCanvas(canvas.current)
    map.current.onMoved = () => {
      map.current.follows = false
      follow(false)
    }
    // Twice a second, and not with each pose: the numbers, and what has become old.
    const timer = setInterval(() => {
      map.current.draw()
      draw((count) => count + 1)
    }, 500)
    return () => {
      clearInterval(timer)
      map.current.end()
    }
  }, [])
  useWatch(Object.keys(topics).length ? { kind: 'map', topics, isCloud, tf } : null, ({ reason, parts, tf: places, bitmap }) => {
    const now = seen.current
    now.reason = reason
    for (const [part, told] of Object.entries(parts)) {
      now.problems[part] = told.problem
      if (!told.problem) now.parts = { ...now.parts, [part]: told }
    }
    if (places) now.parts = { ...now.parts, tf: places }
    map.current.show(now.parts, bitmap)
  })
  const { reason, parts, problems } = seen.current
  const { frame, pose, notes } = arranged(parts)
  const { grid, scan } = parts
  const turn = () => {
    map.current.follow(!follows)
    follow(!follows)
  }
  return html`
    ${reason && html`<p class="notice bad" role="alert">${reason}</p>`}
    ${PARTS.map(([part, label]) => problems[part] && html`<p key=${part} class="notice bad" role="alert">
      ${label}: the last message could not be drawn: <bdi>${problems[part]}</bdi></p>`)}
    <div class="tools">
      <button aria-label="Enlarge" onClick=${() => map.current.zoom(1.3)}>+</button>
      <button aria-label="Make smaller" onClick=${() => map.current.zoom(1 / 1.3)}>−</button>
      <button onClick=${() => map.current.fit()}>Show all</button>
      <button aria-pressed=${follows} disabled=${!pose} onClick=${turn}>Follow</button>
    </div>
    <canvas class="map" ref=${canvas} tabindex="0" role="img"
      aria-label="The map: drag or use the arrow keys to move, the wheel, plus and minus to zoom, 0 to show all" />
    ${notes.map((note) => html`<p key=${note} class="notice">${note}</p>`)}
    <dl class="tiles">
      <div><dt>Position${frame && `, in ${frame}`}</dt><dd>${pose ? `${pose.x.toFixed(2)}, ${pose.y.toFixed(2)} m` : 'none'}</dd></div>
      <div><dt>Heading</dt><dd>${pose && pose.yaw !== null ? `${degrees(pose.yaw)}°` : 'none'}</dd></div>
      <div><dt>Age of the pose</dt><dd>${age(pose)}</dd></div>
      <div><dt>Map</dt><dd>${grid ? `${grid.width} × ${grid.height}, ${Number(grid.resolution.toPrecision(3))} m` : 'none'}</dd></div>
      <div><dt>Scan</dt><dd>${scan ? `${scan.points.length / 2} points` : 'none'}</dd></div>
      <div><dt>Age of the scan</dt><dd>${age(scan)}</dd></div>
    </dl>
    <p class="quiet">Dark cells are occupied, gray ones unknown. Ages are counted from when a message came to this device;
      what is older than 3 s is gray.</p>`
}

function age(part) {
  return part ? `${((Date.now() - part.at) / 1000).toFixed(1)} s` : 'none'
}

function degrees(yaw) {
  return Math.round((yaw * 180) / Math.PI)
}
