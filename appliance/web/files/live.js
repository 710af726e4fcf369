// What a page watches while it is open and can be seen: nothing comes for a page that is hidden.

import { useEffect } from './vendor/hooks.mjs'
import { allRoutes, ask, robot as own, tell } from './link.js'

/**
 * Watch what `values` say, null for nothing; `take` gets one answer after the other.
 * A bitmap in an answer is the taker's.
 */
export function useWatch(values, take) {
  useEffect(() => {
    if (values === null) return undefined
    let run = 0
    const begin = async () => {
      const mine = ++run
      await ask('watch', values)
      for (;;) {
        const answer = mine === run ? await ask('next') : null
        if (mine !== run || answer === null) {
          answer?.bitmap?.close()
          return
        }
        take(answer)
        await new Promise(requestAnimationFrame) // more than can be drawn is not asked for
      }
    }
    // The file of a viewer may be gone after an upgrade.
    const failed = (error) => take({ reason: `This page does not work: ${error.message}. Reload it.`, parts: {} })
    const end = () => {
      run += 1
      tell('unwatch')
    }
    const change = () => {
      end()
      if (!document.hidden) begin().catch(failed)
    }
    document.addEventListener('visibilitychange', change)
    if (!document.hidden) begin().catch(failed)
    return () => {
      document.removeEventListener('visibilitychange', change)
      end()
    }
  }, [JSON.stringify(values)])
}

/** The routes to MQTT of certain types or encodings, of all robots, by their topics: this one's first. */
export function routesOf(isWanted) {
  return allRoutes().filter((route) => route.direction === 'to_mqtt' && isWanted(route))
    .sort((one, other) => (other.robot === own) - (one.robot === own) || (one.mqtt < other.mqtt ? -1 : 1))
}
