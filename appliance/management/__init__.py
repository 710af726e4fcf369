"""Management of the running appliance: the same verbs over MQTT and on the control socket."""
