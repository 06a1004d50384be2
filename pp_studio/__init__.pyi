from .export.formats import export_run as export_run
