from .checks import ADJOINTS as ADJOINTS, combinations as combinations
from .report import (
    certificate_notes as certificate_notes,
    certificate_scope as certificate_scope,
    certificate_table as certificate_table,
    certificate_title as certificate_title,
    is_certified as is_certified,
    write_json as write_json,
)
