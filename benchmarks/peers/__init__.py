"""Methods to compare with: published ones, and ones that anybody would try first."""
