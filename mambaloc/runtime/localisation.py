"""The old name of :mod:`mambaloc.runtime.localization`, which goes in the next release."""

from mambaloc.renamed import renamed
from mambaloc.runtime.localization import Localization as Localization
from mambaloc.runtime.localization import combined as combined

__getattr__ = renamed(__name__, {"Localisation": "Localization"})
