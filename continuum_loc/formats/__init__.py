"""
Clouds and meshes as people have them, each read by a reader that compares promise and content.

A reader takes a file's bytes and gives a `Cloud` or a `Mesh`, or raises MapError naming the file,
the place and what is valid. What a header promises is compared with what is there before memory is
taken for it. Nothing is guessed: what a reader leaves aside it says in `notes`.
"""
