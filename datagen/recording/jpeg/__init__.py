"""A JPEG decoder for recorded rounds: what libjpeg-turbo answers, to the bit, in less time.

It knows one kind of file, the one that rounds are recorded in (baseline, 4:2:0, one scan), and says
so when it is given another: `Decoder.decode` then leaves it to `simplejpeg`, which judges it.
"""
