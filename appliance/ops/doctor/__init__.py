"""`appliance doctor`: looks at everything that the appliance needs, and says what to do."""
