"""Methods of other papers that the project's policies are compared with."""
