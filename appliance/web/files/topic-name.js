// What may be the name of a topic (MQTT 5.0, section 4.7). With a wildcard it would be a filter, and with `$share/` in
// front a shared subscription, which takes messages away from others.

const LARGEST = 65535 // bytes

export function isTopic(name) {
  // eslint-disable-next-line no-control-regex
  return name !== '' && !/[+#\0]|^\$share\//.test(name) && new TextEncoder().encode(name).length <= LARGEST
}
