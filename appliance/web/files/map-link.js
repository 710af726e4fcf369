// A map, a pose and a scan, read and drawn into a bitmap away from the page: a large grid takes
// longer than the page may stand still.

import { cloudOf, gridOf, pixelsOf, poseOf, scanOf } from './geometry.js'
import { Transforms, withoutSlash } from './transforms.js'
import { valueOf } from './values.js'
import { Watch } from './watch-link.js'

const RATES = { grid: 1, pose: 10, scan: 5 } // messages a second
const MOST_WAITING = 500 // messages of TF, each of which may tell of other frames
const BYTES_WAITING = 8 * 1024 * 1024 // of all of them

/** Messages that wait to be read, the newest of them as far as there is room. */
class Waiting {
  messages = []
  bytes = 0

  add(message) {
    this.messages.push(message)
    this.bytes += message.payload.length
    while (this.messages.length > MOST_WAITING || this.bytes > BYTES_WAITING) {
      this.bytes -= this.messages.shift().payload.length
    }
  }

  take() {
    this.bytes = 0
    return this.messages.splice(0)
  }
}

export default class MapView {
  /**
   * `topics` is of grid, pose and scan those that are wanted; `isCloud` for a scan of PointCloud2. `tf` are the topics
   * with transforms: [topic, whether they are static] each.
   */
  constructor(open, { topics, isCloud, tf = [] }) {
    this.transforms = tf.length ? new Transforms() : null
    this.told = new Waiting() // of TF: what is to be read
    this.toldOnce = new Waiting() // and of what is static: nobody tells it again, so that /tf must not push it out
    this.known = {} // of each part its frame and time
    this.readers = { grid: gridOf, pose: poseOf, scan: isCloud ? cloudOf : scanOf }
    this.newest = {}
    const parts = Object.keys(RATES).filter((part) => topics[part])
    const wanted = parts.map((part) => [topics[part], RATES[part]])
    wanted.push(...tf.map(([topic]) => [topic, 0]))
    this.watch = new Watch(open, wanted, (topic, payload, properties, at) => {
      const transform = tf.find(([name]) => name === topic)
      if (transform) {
        const told = transform[1] ? this.toldOnce : this.told
        told.add({ payload, properties, isStatic: transform[1] })
      }
      for (const part of parts) {
        if (topics[part] === topic) this.newest[part] = { payload, properties, at }
      }
    })
  }

  stop() {
    this.watch.stop()
  }

  /** What is new: parts by their names, each read or with its problem; null when it is over. */
  async next() {
    if (!await this.watch.news()) return null
    const { newest, watch } = this
    this.newest = {}
    const told = { reason: watch.reason, parts: {} }
    for (const [part, { payload, properties, at }] of Object.entries(newest)) {
      try {
        const read = this.readers[part](await valueOf(payload, properties))
        if (part === 'grid') {
          told.bitmap = await createImageBitmap(new ImageData(pixelsOf(read), read.width, read.height))
          delete read.cells
        }
        told.parts[part] = { at, problem: '', ...read }
        this.known[part] = { frame: withoutSlash(read.frame), stamp: read.stamp ?? 0 }
      } catch (error) {
        told.parts[part] = { at, problem: String(error?.message ?? error).slice(0, 200) }
      }
    }
    if (this.transforms) told.tf = await this.placements()
    return told
  }

  /** Where pose and scan are in the frame of the map: of each what `between` tells, or a problem. */
  async placements() {
    const { transforms, known } = this
    transforms.problem = ''
    for (const { payload, properties, isStatic } of [...this.toldOnce.take(), ...this.told.take()]) {
      try {
        transforms.take(await valueOf(payload, properties), isStatic)
      } catch (error) {
        transforms.problem = `A message of TF could not be read: ${String(error?.message ?? error).slice(0, 200)}`
      }
    }
    const found = { problem: transforms.problem }
    const target = (known.grid ?? known.pose ?? known.scan)?.frame
    for (const part of ['pose', 'scan']) {
      if (!known[part] || known[part].frame === target) continue
      try {
        found[part] = { place: transforms.between(known[part].frame, target, known[part].stamp) }
      } catch (error) {
        found[part] = { problem: error.message }
      }
    }
    return found
  }
}
