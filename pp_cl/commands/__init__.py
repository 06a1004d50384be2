"""The commands: modules with HELP, add_arguments(parser), run(options). Only commands print."""

__all__ = ["COMMANDS"]

# the module of each command, imported when it is given; in the order of the help
COMMANDS = {
    "devices": "pp_cl.commands.devices",
    "make": "pp_studio.commands.make",
    "capture": "pp_studio.commands.capture",
    "train": "pp_cl.commands.train",
    "eval": "pp_cl.commands.eval",
    "sweep": "pp_studio.commands.sweep",
    "info": "pp_cl.commands.info",
    "render": "pp_studio.commands.render",
    "view": "pp_studio.commands.view",
    "export": "pp_studio.commands.export",
    "compare": "pp_cl.commands.compare",
    "bench": "pp_cl.commands.bench",
    "selftest": "pp_cl.commands.selftest",
}
