"""The commands of pp-cl, one module each: HELP, add_arguments(parser), run(options).

Here text becomes numbers, and here alone is printed. A module imports what needs OpenCL only when
its command runs, so that --help is quick.
"""
