from .checks import ADJOINTS as ADJOINTS, combinations as combinations
from .report import (
    certificate_table as certificate_table,
    is_certified as is_certified,
    write_json as write_json,
)
