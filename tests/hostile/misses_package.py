"""Needs a package that is not there."""

import no_such_package_at_all

no_such_package_at_all.use()
