"""What users open elsewhere, one file per format: values in, bytes out.

A format's file has `VERSION`; the name or names of what it makes, as the part that follows tile and variant
(`NAME`); the media type (`MEDIA_TYPE`); and pure functions that turn values into bytes.
"""
