"""Tables: text files, Excel workbooks, Parquet files and data frames become one table of text and numbers.

`read_table` reads any of them. What the columns mean belongs to the readers of measurement and DH files.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
