// The map on its canvas, moved and enlarged by touch, pointer, wheel and keys.

import { OLD, arranged, corners } from './arrange.js'
import { START, fitted, panned, zoomed } from './viewport.js'

const SHARPEST = 2 // pixels of the canvas for one of CSS
const STEP = 60 // pixels that a key moves
const FACTOR = 1.3 // by which a key enlarges

const KEYS = {
  ArrowLeft: (map) => map.pan(STEP, 0), ArrowRight: (map) => map.pan(-STEP, 0),
  ArrowUp: (map) => map.pan(0, STEP), ArrowDown: (map) => map.pan(0, -STEP),
  '+': (map) => map.zoom(FACTOR), '=': (map) => map.zoom(FACTOR), '-': (map) => map.zoom(1 / FACTOR),
  0: (map) => map.fit(),
}

export class MapCanvas {
  constructor(canvas) {
    this.canvas = canvas
    this.parts = {}
    this.bitmap = null
    this.view = START
    this.isMoved = false // by somebody: then it stays
    this.follows = false
    this.pointers = new Map()
    this.frame = null
    this.observer = new ResizeObserver(() => this.draw())
    this.observer.observe(canvas)
    this.listeners = [
      ['pointerdown', (event) => this.down(event)],
      ['pointermove', (event) => this.move(event)],
      ...['pointerup', 'pointercancel', 'lostpointercapture'].map((name) => [name, (event) => {
        this.pointers.delete(event.pointerId)
      }]),
      ['wheel', (event) => this.wheel(event)],
      ['keydown', (event) => this.key(event)],
    ]
    for (const [name, listener] of this.listeners) canvas.addEventListener(name, listener, { passive: false })
  }

  end() {
    for (const [name, listener] of this.listeners) this.canvas.removeEventListener(name, listener)
    this.observer.disconnect()
    cancelAnimationFrame(this.frame)
    this.bitmap?.close()
  }

  /** Draw these parts from now on; a bitmap is that of a new grid. */
  show(parts, bitmap) {
    const isFirst = Object.keys(parts).some((part) => !this.parts[part])
    this.parts = parts
    if (bitmap) {
      this.bitmap?.close()
      this.bitmap = bitmap
    }
    const { pose } = arranged(parts)
    if (this.follows && pose) this.view = { ...this.view, x: pose.x, y: pose.y }
    else if (!this.isMoved && (isFirst || bitmap)) this.fit()
    this.draw()
  }

  follow(follows) {
    this.follows = follows
    this.isMoved ||= follows
    this.show(this.parts, null)
  }

  fit() {
    const { grid } = this.parts
    const { pose, points } = arranged(this.parts)
    const all = [...(grid ? corners(grid) : points ?? []), ...(pose ? [pose.x, pose.y] : [])]
    this.view = fitted(all, this.canvas.clientWidth, this.canvas.clientHeight)
    this.isMoved = false
    this.draw()
  }

  pan(right, down) {
    this.view = panned(this.view, right, down)
    this.isMoved = true
    this.onMoved?.()
    this.draw()
  }

  zoom(factor, right, down) {
    this.view = zoomed(this.view, factor, right, down)
    this.isMoved = true
    this.draw()
  }

  // --- input -----------------------------------------------------------------------------------

  down(event) {
    if (event.button !== 0 || this.pointers.size >= 2) return
    this.pointers.set(event.pointerId, [event.clientX, event.clientY])
    this.canvas.setPointerCapture(event.pointerId)
  }

  move(event) {
    const before = this.pointers.get(event.pointerId)
    if (before === undefined) return
    const now = [event.clientX, event.clientY]
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1]
    this.pointers.set(event.pointerId, now)
    const share = other ? 0.5 : 1 // of two fingers each moves the middle half as far
    this.pan(share * (now[0] - before[0]), share * (now[1] - before[1]))
    if (!other) return
    const apart = ([x, y]) => Math.max(20, Math.hypot(x - other[0], y - other[1]))
    this.zoom(apart(now) / apart(before), ...this.fromMiddle((now[0] + other[0]) / 2, (now[1] + other[1]) / 2))
  }

  wheel(event) {
    event.preventDefault()
    const lines = event.deltaMode === 0 ? event.deltaY / 100 : event.deltaY / 3
    const factor = FACTOR ** -Math.max(-3, Math.min(3, lines))
    this.zoom(factor, ...(this.follows ? [0, 0] : this.fromMiddle(event.clientX, event.clientY)))
  }

  key(event) {
    if (!Object.hasOwn(KEYS, event.key) || event.ctrlKey || event.altKey || event.metaKey) return
    event.preventDefault()
    KEYS[event.key](this)
  }

  fromMiddle(x, y) {
    const box = this.canvas.getBoundingClientRect()
    return [x - box.left - box.width / 2, y - box.top - box.height / 2]
  }

  // --- drawing ---------------------------------------------------------------------------------

  draw() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null
      this.paint()
    })
  }

  paint() {
    const { canvas, view, parts } = this
    const sharp = Math.min(SHARPEST, devicePixelRatio || 1)
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.max(1, Math.round(size * sharp)))
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height })
    const context = canvas.getContext('2d')
    const scale = view.scale * sharp
    const style = getComputedStyle(document.documentElement)
    const colour = (name) => style.getPropertyValue(name)
    const metres = () => context.setTransform(scale, 0, 0, -scale, width / 2 - view.x * scale, height / 2 + view.y * scale)
    context.setTransform(1, 0, 0, 1, 0, 0)
    context.fillStyle = colour('--line')
    context.fillRect(0, 0, width, height)
    metres()
    if (parts.grid && this.bitmap) this.paintGrid(context, parts.grid)
    const toPixels = (x, y) => [width / 2 + (x - view.x) * scale, height / 2 - (y - view.y) * scale]
    context.setTransform(1, 0, 0, 1, 0, 0)
    const isOld = ({ at }) => Date.now() - at > OLD
    const { pose, points } = arranged(parts)
    if (points) {
      context.fillStyle = isOld(parts.scan) ? colour('--dim') : '#e02424'
      const size = 3 * sharp
      for (let at = 0; at < points.length; at += 2) {
        const [x, y] = toPixels(points[at], points[at + 1])
        if (x > -size && y > -size && x < width && y < height) context.fillRect(x - size / 2, y - size / 2, size, size)
      }
    }
    if (pose) this.paintRobot(context, pose, toPixels, Math.max(0.25 * scale, 11 * sharp), isOld(pose))
    this.paintScale(context, colour, sharp, scale, height)
  }

  /** The grid as it is: a cell is a square, and nothing between two cells is made up. */
  paintGrid(context, grid) {
    context.imageSmoothingEnabled = false
    context.translate(grid.x, grid.y)
    context.rotate(grid.yaw)
    context.drawImage(this.bitmap, 0, 0, grid.width * grid.resolution, grid.height * grid.resolution)
  }

  paintRobot(context, { x, y, yaw }, toPixels, size, isOld) {
    context.setTransform(1, 0, 0, 1, ...toPixels(x, y))
    context.beginPath()
    if (yaw === null) context.arc(0, 0, size * 0.7, 0, 2 * Math.PI)
    else {
      context.rotate(-yaw)
      context.moveTo(size, 0)
      context.lineTo(-size * 0.7, size * 0.7)
      context.lineTo(-size * 0.35, 0)
      context.lineTo(-size * 0.7, -size * 0.7)
      context.closePath()
    }
    context.fillStyle = isOld ? '#8a8a8a' : '#1a6fd6'
    context.strokeStyle = '#ffffff'
    context.lineWidth = Math.max(2, size / 8)
    context.stroke()
    context.fill()
  }

  /** A bar of 1, 2 or 5 times a power of ten in metres. */
  paintScale(context, colour, sharp, scale, height) {
    const wanted = (100 * sharp) / scale
    const power = 10 ** Math.floor(Math.log10(wanted))
    const length = [5, 2, 1].map((times) => times * power).find((each) => each <= wanted) ?? power
    const [left, bottom, thick] = [12 * sharp, height - 12 * sharp, 4 * sharp]
    context.setTransform(1, 0, 0, 1, 0, 0)
    context.font = `${13 * sharp}px system-ui, sans-serif`
    const text = `${Number(length.toPrecision(1))} m`
    context.fillStyle = colour('--card')
    context.fillRect(left - thick, bottom - 26 * sharp, Math.max(length * scale, context.measureText(text).width) + 2 * thick, 30 * sharp)
    context.fillStyle = colour('--text')
    context.fillRect(left, bottom - thick, length * scale, thick)
    context.fillText(text, left, bottom - 9 * sharp)
  }
}
