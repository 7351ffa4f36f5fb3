"""Series of frames of a fixed field: how the image moves while a camera warms up."""
