"""The diagnosis scored on campaigns whose truth is concealed."""
