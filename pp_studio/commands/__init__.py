"""The studio's commands, one module each, found by the table in pp_cl.commands."""
