"""The old name of :mod:`mambaloc.runtime.localizer`, which goes in the next release."""

from mambaloc.renamed import renamed
from mambaloc.runtime.localizer import Localizer as Localizer

__getattr__ = renamed(__name__, {"Localiser": "Localizer"})
