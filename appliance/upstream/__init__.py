"""The link to a fleet's broker: the appliance as an MQTT client, with topics carried both ways."""
