"""Recordings: the only room that reads them, giving arrays with conditions."""
