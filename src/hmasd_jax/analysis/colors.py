"""Colors of figures, films and reports."""

OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colors that color-blind readers can tell apart (Okabe and Ito, 2008)."""
