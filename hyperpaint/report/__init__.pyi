from .static_site import write_site as write_site
from .store_report import write_report as write_report
