"""The candidates: every effect that the model may lack, with its form, site, arguments and grid."""
