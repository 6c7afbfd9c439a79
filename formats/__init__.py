"""File formats: meshes, images, scenes, samples and assets, each with a record in memory, a reader and its checks.

Every reader and writer uses `errors` (error classes, warnings), `atomic` (writes that never damage an older file) and
`interrupts` (Ctrl-C waits until a file is consistent). `hdf5_file` opens assets and sample files, `hdf5_sink` writes
them to a disk that may be full. `journal` stores the progress of bakes, `json_report` writes reports.
May import: nothing else of the product. Begin with the folder of a format.
"""
