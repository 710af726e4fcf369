// The overview's part about the bridge: what it carries in a second, in all and by topic.

import { h } from './vendor/preact.mjs'
import htm from './vendor/htm.mjs'
import { size } from './formats.js'
import { useRoutes } from './routes.js'

const html = htm.bind(h)

const SHOWN = 200

export default function Bridged() {
  const { all } = useRoutes()
  return [...new Set(all.map(({ robot }) => robot))].map((robot) => html`<${Robot} key=${robot} robot=${robot}
    routes=${all.filter((route) => route.robot === robot)} />`)
}

function Robot({ robot, routes }) {
  const ways = [['to_mqtt', 'ROS to MQTT'], ['to_ros', 'MQTT to ROS']]
  return html`<section><h2>Bridged topics of <bdi>${robot}</bdi></h2>
    <dl class="tiles">${ways.map(([way, label]) => html`<div><dt>${label}, a second</dt>
      <dd>${totalOf(routes.filter(({ direction }) => direction === way))}</dd></div>`)}</dl>
    <div class="scroll" tabindex="0" role="region" aria-label="Bridged topics"><table class="bridged">
    <thead><tr><th>ROS</th><th>MQTT</th><th class="number">Hz</th><th class="number">bytes</th></tr></thead>
    <tbody>${routes.slice(0, SHOWN).map((route) => html`<tr key=${route.key}>
      <td><a href=${`#/routes/${encodeURIComponent(route.key)}`}><bdi>${route.ros}</bdi></a></td>
      <td>${route.direction === 'to_ros' ? '←' : '→'} <a href=${`#/topics/${encodeURIComponent(route.mqtt)}`}>
        <bdi>${route.mqtt}</bdi></a></td>
      <td class="number">${route.rate}</td><td class="number">${route.size}</td></tr>`)}</tbody>
  </table></div></section>`
}

function totalOf(routes) {
  const sum = (of) => routes.reduce((total, route) => total + of(route), 0)
  const bytes = sum(({ byte_rate: exact, rate = 0, size: mean = 0 }) => exact ?? rate * mean)
  return `${sum(({ rate = 0 }) => rate).toFixed(1)} messages, ${size(Math.round(bytes))}`
}
