"""The shared language of armrig: what is on the wire, in the files and in the logs.

Pure definitions and codecs. No sockets, no threads; the machine's clock is read in `protocols.clock` alone.
"""
