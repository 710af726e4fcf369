"""`appliance doctor`: examines everything that the appliance needs, and says what to do."""
