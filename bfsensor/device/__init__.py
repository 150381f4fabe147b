"""What a sensor is made of and how it is operated; laws of silicon."""
