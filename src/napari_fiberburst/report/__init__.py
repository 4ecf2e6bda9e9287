"""What a reconstruction is, rests on and was made with, as one page that stands alone."""

from napari_fiberburst.report.page import check_report, write_report

__all__ = ["check_report", "write_report"]
