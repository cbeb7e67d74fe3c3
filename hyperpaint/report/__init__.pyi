from .store_report import write_report as write_report, write_site as write_site
