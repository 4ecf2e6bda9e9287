"""What a reconstruction is, rests on and was made with, as one page; and a figure of it for a paper."""

from napari_fiberburst.report.before_after import check_figure, write_figure
from napari_fiberburst.report.page import check_report, write_report

__all__ = ["check_figure", "check_report", "write_figure", "write_report"]
